//! The data streams of the links.

use std::time::Duration;

use axon_shm::ids::DaemonId;
use quinn_proto::{Dir, StreamEvent};

use super::Engine;
use crate::link::CloseCode;

impl Engine {
    pub(super) fn handle_stream(
        &mut self,
        now: Duration,
        number: u64,
        daemon: DaemonId,
        event: StreamEvent,
    ) {
        let Some(peer) = self.peers.get_mut(daemon) else { return };
        let in_use = peer.link == number;
        match event {
            StreamEvent::Opened { dir: Dir::Uni } => {
                peer.inbound.handle_elected(number);
                while let Some(connection) = self.links.connection(number)
                    && let Some(stream) = connection.quic.streams().accept(Dir::Uni)
                {
                    peer.inbound.handle_readable(number, stream);
                }
            }
            StreamEvent::Opened { .. } => {}
            StreamEvent::Readable { id } => peer.inbound.handle_readable(number, id),
            StreamEvent::Available { .. } if in_use => peer.outbound.handle_streams_available(),
            StreamEvent::Writable { id } if in_use => {
                if let Some(flow) = self.links.view(number).and_then(|link| link.flow_of(id)) {
                    peer.outbound.handle_writable(flow);
                }
            }
            StreamEvent::Finished { id } => {
                let Some(connection) = self.links.connection(number) else { return };
                if connection.copies.handle_over(id) {
                    return;
                }
                let Some(flow) = connection.flows.remove(&id) else { return };
                if in_use {
                    peer.outbound.handle_finished(now, flow, id, &mut connection.quic);
                }
            }
            StreamEvent::Stopped { id, .. } => {
                let Some(connection) = self.links.connection(number) else { return };
                if connection.copies.handle_stopped(&mut connection.quic, id) || !in_use {
                    return;
                }
                let Some(flow) = connection.flows.remove(&id) else { return };
                peer.outbound.handle_stopped(flow, id, &mut connection.quic);
            }
            _ => {}
        }
    }

    /// Reads data streams as far as they go. Returns whether there was anything.
    pub(super) fn read_streams(&mut self, left: &mut usize, now: Duration) -> bool {
        let mut read = false;
        let mut violations = Vec::new();
        for peer in self.peers.values_mut() {
            peer.inbound.look_for_memory();
            // Only the streams that are ready now are read. A stream that has more comes after the others, and after
            // the work that they cause.
            for _ in 0..peer.inbound.ready() {
                if *left == 0 {
                    break;
                }
                let Some((number, stream)) = peer.inbound.next_ready() else { break };
                read = true;
                let Some((quic, mut open, copies_alone)) = self.links.reader(number) else {
                    peer.inbound.forget_stream((number, stream));
                    continue;
                };
                let key = (number, stream);
                match peer.inbound.read(key, quic, &mut open, copies_alone, now) {
                    Ok(bytes) => *left = left.saturating_sub(bytes),
                    Err((code, why)) => violations.push((number, code, why)),
                }
                self.links.touch(number);
            }
        }
        for (number, code, why) in violations {
            let told = match code {
                CloseCode::Envelope => "an envelope was refused",
                _ => &why,
            };
            self.links.violation_told(number, code, &why, told, now);
        }
        self.peers.wait_for_room();
        read
    }
}
