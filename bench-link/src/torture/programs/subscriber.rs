//! Takes samples, and checks their bytes.

use std::sync::mpsc::{Receiver, TryRecvError};

use axon_transport::Session;

use super::{LOOK, broken, key};
use crate::{
    Result,
    part::{now_ns, say},
    torture::{
        content::check,
        words::{Order, Report, Topic},
    },
};

pub(super) fn run(session: &Session, topic: Topic, orders: &Receiver<Order>) -> Result<()> {
    let subscription = session.create_subscription(topic.subscription())?;
    say(&Report::Ready { gid: subscription.gid().to_string() })?;
    let (mut lost, mut bytes) = (0, Vec::new());
    while !matches!(orders.try_recv(), Err(TryRecvError::Disconnected)) {
        if let Ok(info) = subscription.recv(&mut bytes, Some(LOOK)) {
            let (publisher, number) = (info.publisher.to_string(), info.sequence);
            match check(&bytes, key(info.publisher), number) {
                Ok(sent) => say(&Report::Took { publisher, number, sent, at: now_ns() })?,
                Err(what) => broken(format!("sample {number} of {publisher}: {what}"))?,
            }
        }
        let total = subscription.lost();
        if total != lost {
            lost = total;
            say(&Report::Lost { total })?;
        }
    }
    Ok(())
}
