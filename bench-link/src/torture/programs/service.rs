//! Calls a service of the other host, and answers the calls of the other host.

use std::{
    sync::mpsc::{Receiver, TryRecvError},
    time::{Duration, Instant},
};

use axon_shm::qos::Qos;
use axon_transport::{EndpointSpec, Session, ids::Gid};
use rand::{RngExt, rngs::StdRng};

use super::{LOOK, broken, is_for_now, key, length};
use crate::{
    Result,
    part::{now_ns, say},
    torture::{
        content::{SHORTEST, check, fill},
        words::{Order, Report},
    },
};

/// The longest time from call to call, in milliseconds.
const PAUSE_MS: u64 = 400;
/// The longest request, in bytes.
const LONGEST: usize = 50_000;

fn spec(host: usize) -> EndpointSpec {
    EndpointSpec::new(format!("/service_{host}"), "bench/Service", Qos::keep_all())
}

pub(super) fn call(
    session: &Session,
    host: usize,
    orders: &Receiver<Order>,
    random: &mut StdRng,
) -> Result<()> {
    let client = session.create_client(spec(host))?;
    say(&Report::Ready { gid: client.gid().to_string() })?;
    let (mut number, mut is_quiet, mut next) = (0, false, Instant::now());
    let (mut request, mut response) = (Vec::new(), Vec::new());
    loop {
        match orders.try_recv() {
            Ok(Order::Quiet) => is_quiet = true,
            Err(TryRecvError::Disconnected) => return Ok(()),
            Ok(_) | Err(TryRecvError::Empty) => {}
        }
        if let Ok(info) = client.recv_response(&mut response, Some(LOOK)) {
            let (server, number) = (info.publisher, info.sequence);
            match check(&response, key(server) ^ key(client.gid()), number) {
                Ok(_) => {
                    say(&Report::Answered { server: server.to_string(), number, at: now_ns() })?;
                }
                Err(what) => broken(format!("the answer of {server} to call {number}: {what}"))?,
            }
        }
        if is_quiet || Instant::now() < next {
            continue;
        }
        next = Instant::now() + Duration::from_millis(random.random_range(0..PAUSE_MS));
        let at = now_ns();
        request.resize(length(random, (SHORTEST, LONGEST)), 0);
        fill(&mut request, key(client.gid()), number + 1, at);
        let mut servers = client.servers();
        match client.send_request(&request) {
            Ok(sent) => {
                number += 1;
                if sent != number {
                    broken(format!("call {sent} after {}", number - 1))?;
                }
                let after = client.servers();
                servers.retain(|server| after.contains(server));
                let servers = servers.iter().map(Gid::to_string).collect();
                say(&Report::Called { number, servers, at })?;
            }
            Err(error) if is_for_now(&error) => {}
            Err(error) => return Err(error.into()),
        }
    }
}

pub(super) fn answer(session: &Session, host: usize, orders: &Receiver<Order>) -> Result<()> {
    let server = session.create_server(spec(host))?;
    say(&Report::Ready { gid: server.gid().to_string() })?;
    let (mut request, mut response) = (Vec::new(), Vec::new());
    let is_over = || matches!(orders.try_recv(), Err(TryRecvError::Disconnected));
    while !is_over() {
        let Ok(info) = server.recv_request(&mut request, Some(LOOK)) else { continue };
        let (client, number) = (info.publisher, info.sequence);
        match check(&request, key(client), number) {
            Ok(_) => say(&Report::Served { client: client.to_string(), number, at: now_ns() })?,
            Err(what) => broken(format!("call {number} of {client}: {what}"))?,
        }
        response.resize(request.len(), 0);
        fill(&mut response, key(client) ^ key(server.gid()), number, now_ns());
        while let Err(error) = server.send_response(client, number, &response) {
            if !is_for_now(&error) {
                return Err(error.into());
            }
            if is_over() || !server.clients().contains(&client) {
                break;
            }
        }
    }
    Ok(())
}
