//! The thread that compresses samples, one after the other: they take one processor at most. It starts with the first.

use std::{
    sync::mpsc::{Receiver, Sender, channel},
    thread,
    time::{Duration, Instant},
};

use tokio::sync::mpsc;

use super::inputs::TaskResult;
use crate::engine::compression::{CompressionAnswer, CompressionOrder, Compressor};

/// The thread, as the reactor has it.
pub(super) struct CompressorThread {
    orders: Option<Sender<CompressionOrder>>,
    report: mpsc::UnboundedSender<TaskResult>,
}

impl CompressorThread {
    /// Creates a compressor whose thread has not started. Its answers go to `report`.
    pub(super) fn new(report: mpsc::UnboundedSender<TaskResult>) -> Self {
        Self { orders: None, report }
    }

    /// Orders the compression of a sample.
    pub(super) fn submit(&mut self, order: CompressionOrder) {
        let orders = self.orders.get_or_insert_with(|| start(self.report.clone()));
        if let Err(unsent) = orders.send(order) {
            // Without a thread samples are sent as they are.
            let number = unsent.0.number;
            let answer = CompressionAnswer { number, compressed: None, took: Duration::ZERO };
            let _ = self.report.send(TaskResult::Compressed(answer));
        }
    }
}

/// Starts the thread. It ends with the sender of its orders, or with the receiver of its answers.
fn start(report: mpsc::UnboundedSender<TaskResult>) -> Sender<CompressionOrder> {
    let (orders, taken) = channel();
    let started = thread::Builder::new()
        .name("axon-zstd".into())
        .spawn(move || compress_all(&taken, &report));
    if let Err(error) = started {
        tracing::warn!(%error, "could not start the thread that compresses samples: none are compressed");
    }
    orders
}

fn compress_all(orders: &Receiver<CompressionOrder>, report: &mpsc::UnboundedSender<TaskResult>) {
    let (mut compressor, started) = (Compressor::new(), Instant::now());
    while let Ok(order) = orders.recv() {
        let answer = compressor.compress(&order, || started.elapsed());
        if report.send(TaskResult::Compressed(answer)).is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn order(number: u64, payload: Vec<u8>) -> CompressionOrder {
        CompressionOrder { number, payload: payload.into() }
    }

    #[test]
    fn each_order_is_answered_in_turn() {
        let (report, mut done) = mpsc::unbounded_channel();
        let mut thread = CompressorThread::new(report);
        for number in 1..=100 {
            thread.submit(order(number, vec![number as u8; 10_000]));
        }
        for number in 1..=100 {
            let Some(TaskResult::Compressed(answer)) = done.blocking_recv() else {
                panic!("no answer")
            };
            assert_eq!(answer.number, number);
            let frame = answer.compressed.unwrap();
            let payload = zstd::bulk::decompress(&frame, 10_000).unwrap();
            assert_eq!(payload, vec![number as u8; 10_000]);
        }
    }

    #[test]
    fn without_a_thread_each_order_is_answered_at_once() {
        let (report, mut done) = mpsc::unbounded_channel();
        let (orders, taken) = channel();
        drop(taken);
        let mut thread = CompressorThread { orders: Some(orders), report };
        thread.submit(order(7, vec![0; 10_000]));
        let Some(TaskResult::Compressed(answer)) = done.blocking_recv() else {
            panic!("no answer")
        };
        assert_eq!((answer.number, answer.compressed), (7, None));
    }
}
