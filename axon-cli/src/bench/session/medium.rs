//! Measures sessions, used as their documentation recommends.

use std::{
    sync::atomic::{AtomicU32, Ordering},
    time::Duration,
};

use axon_transport::{
    Client, EndpointSpec, Publisher, Server, Session, Subscription, Waitable, ids::Gid, qos::Qos,
};

use super::place::{MATCH_TIMEOUT, Settings, daemon_pid, session};
use crate::bench::harness::{
    Channel, End, Error, Load, Medium, Motion, Result, Side, agree, qos, stamp,
};

/// The longest sleep. A message ends it earlier.
const LONGEST_SLEEP: Option<Duration> = Some(Duration::from_secs(1));
/// A sample of up to this size is copied in any case.
const COPIED: usize = 4096;
/// A loan of up to this size is copied as well.
const LOANS_COPIED: usize = 512;

/// The number of the next end, which makes its topics unique.
static NUMBER: AtomicU32 = AtomicU32::new(0);

/// The settings of the hosts of the process that measures and of the other process. Both may be the
/// same host. Only the process that measures has them, and it sends the other process its own.
pub(in crate::bench) type Hosts = Option<[Settings; 2]>;

/// A publisher and a subscription in each of two sessions.
pub(in crate::bench) struct Sessions(pub(in crate::bench) Hosts);

/// A service: a request there and its response back. Both are copied in and out.
pub(super) struct Service(pub(super) Hosts);

/// Opens the session of this end. Returns it with the name that both ends share.
fn meet(hosts: &Hosts, side: Side, channel: &Channel) -> Result<(Session, String)> {
    let (settings, name) = match side {
        Side::Near => {
            let [near, far] = hosts.as_ref().ok_or("no daemon was started")?;
            let name = format!("/bench/{}", NUMBER.fetch_add(1, Ordering::Relaxed));
            channel.tell(&(far, &name))?;
            (near.clone(), name)
        }
        Side::Far => channel.hear::<(Settings, String)>()?,
    };
    Ok((session(&settings)?, name))
}

/// Returns the process ids of the daemons of both hosts, without duplicates.
fn daemons(hosts: &Hosts) -> Result<Vec<u32>> {
    let mut pids = Vec::new();
    for settings in hosts.iter().flatten() {
        let pid = daemon_pid(settings)?;
        if !pids.contains(&pid) {
            pids.push(pid);
        }
    }
    Ok(pids)
}

fn spec(name: &str, qos: Qos) -> EndpointSpec {
    EndpointSpec::new(name, "bench/Bytes", qos)
}

impl Medium for Sessions {
    fn name(&self) -> &'static str {
        "session"
    }

    fn daemons(&self) -> Result<Vec<u32>> {
        daemons(&self.0)
    }

    fn open(&self, load: &Load, side: Side, channel: &Channel) -> Result<Box<dyn End>> {
        let (session, name) = meet(&self.0, side, channel)?;
        let (out, back) = match side {
            Side::Near => ("there", "back"),
            Side::Far => ("back", "there"),
        };
        let expected_len = load.size as u64;
        let spec = |way| {
            let spec = spec(&format!("{name}/{way}"), qos(load.window)?);
            Ok::<_, Error>(spec.expected_len(expected_len))
        };
        let subscription = session.create_subscription(spec(back)?)?;
        let publisher = session.create_publisher(spec(out)?)?;
        if !publisher.wait_matched(1, MATCH_TIMEOUT) || !subscription.wait_matched(1, MATCH_TIMEOUT)
        {
            return Err("the two sessions do not meet".into());
        }
        let loans = load.motion == Motion::Touch && load.size > LOANS_COPIED;
        Ok(Box::new(SessionEnd {
            publisher,
            subscription,
            session,
            size: load.size,
            sleeps: load.wake.sleeps(),
            loans,
            copies: !(loans || load.size > COPIED) || load.motion == Motion::Copy,
            bytes: vec![0x5a; load.size],
        }))
    }
}

struct SessionEnd {
    publisher: Publisher,
    subscription: Subscription,
    session: Session,
    size: usize,
    sleeps: bool,
    loans: bool,
    copies: bool,
    bytes: Vec<u8>,
}

impl End for SessionEnd {
    fn send(&mut self, number: u64) -> Result<()> {
        if self.loans {
            let mut loan = self.publisher.loan(self.size)?;
            stamp(&mut loan, number);
            loan.publish()?;
        } else {
            stamp(&mut self.bytes, number);
            self.publisher.publish(&self.bytes)?;
        }
        Ok(())
    }

    fn receive(&mut self) -> Result<u64> {
        loop {
            if self.sleeps {
                let subscription = Waitable::Subscription(&self.subscription);
                self.session.wait_for(&[subscription], LONGEST_SLEEP)?;
            }
            if self.copies {
                if self.subscription.take(&mut self.bytes).is_some() {
                    return numbered(&self.bytes);
                }
            } else if let Some((_, sample)) = self.subscription.take_sample() {
                let [mut first, mut last] = [[0; 8]; 2];
                sample.read_at(0, &mut first);
                sample.read_at(self.size - 8, &mut last);
                return agree(first, last);
            }
        }
    }
}

impl Medium for Service {
    fn name(&self) -> &'static str {
        "service"
    }

    fn carries(&self, load: &Load) -> bool {
        load.motion == Motion::Copy && !load.is_stream()
    }

    fn daemons(&self) -> Result<Vec<u32>> {
        daemons(&self.0)
    }

    fn open(&self, load: &Load, side: Side, channel: &Channel) -> Result<Box<dyn End>> {
        let (session, name) = meet(&self.0, side, channel)?;
        let (sleeps, bytes) = (load.wake.sleeps(), vec![0x5a; load.size]);
        if side == Side::Near {
            let client = session.create_client(spec(&name, Qos::default()))?;
            if !client.wait_available(MATCH_TIMEOUT) {
                return Err("there is no server".into());
            }
            return Ok(Box::new(Asking { client, session, sleeps, bytes }));
        }
        let server = session.create_server(spec(&name, Qos::default()))?;
        let asked = None;
        Ok(Box::new(Answering { server, session, sleeps, bytes, asked }))
    }
}

struct Asking {
    client: Client,
    session: Session,
    sleeps: bool,
    bytes: Vec<u8>,
}

impl End for Asking {
    fn send(&mut self, number: u64) -> Result<()> {
        stamp(&mut self.bytes, number);
        self.client.send_request(&self.bytes)?;
        Ok(())
    }

    fn receive(&mut self) -> Result<u64> {
        loop {
            if self.sleeps {
                self.session.wait_for(&[Waitable::Client(&self.client)], LONGEST_SLEEP)?;
            }
            if self.client.take_response(&mut self.bytes).is_some() {
                return numbered(&self.bytes);
            }
        }
    }
}

struct Answering {
    server: Server,
    session: Session,
    sleeps: bool,
    bytes: Vec<u8>,
    /// The client of the last request, and the request's number.
    asked: Option<(Gid, u64)>,
}

impl End for Answering {
    fn send(&mut self, number: u64) -> Result<()> {
        let (client, sequence) = self.asked.take().ok_or("an answer that nobody asked for")?;
        stamp(&mut self.bytes, number);
        self.server.send_response(client, sequence, &self.bytes)?;
        Ok(())
    }

    fn receive(&mut self) -> Result<u64> {
        loop {
            if self.sleeps {
                self.session.wait_for(&[Waitable::Server(&self.server)], LONGEST_SLEEP)?;
            }
            if let Some(info) = self.server.take_request(&mut self.bytes) {
                self.asked = Some((info.publisher, info.sequence));
                return numbered(&self.bytes);
            }
        }
    }
}

fn numbered(bytes: &[u8]) -> Result<u64> {
    agree(*bytes.first_chunk().ok_or("too short")?, *bytes.last_chunk().ok_or("too short")?)
}
