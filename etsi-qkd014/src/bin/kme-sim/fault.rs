//! `kme-sim fault`: changes the faults of KMEs that run.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use clap::{Args, Subcommand};
use etsi_qkd014::sim::FaultPlan;
use serde_json::Value;

use crate::{CommandFailure, CommandResult, other, say};

const TIME: Duration = Duration::from_secs(5);
const MAX_ANSWER: u64 = 1 << 20;

/// Changes the faults of KMEs that run, over the address given to `kme-sim run --control`.
#[derive(Args)]
pub(crate) struct Arguments {
    /// The control address of the running KMEs.
    #[arg(long, value_name = "ADDRESS:PORT")]
    control: SocketAddr,
    #[command(subcommand)]
    action: Action,
}

#[derive(Subcommand)]
enum Action {
    /// Prints the plans that wait at each KME.
    List,
    /// Prints the KMEs, and what each has done so far.
    Kmes,
    /// Adds plans to those of a KME.
    Add {
        /// The KME's ID.
        kme: String,
        /// As cut, latency=250 or reset,times=2,on=dec_keys.
        #[arg(required = true)]
        plans: Vec<FaultPlan>,
    },
    /// Replaces the plans of a KME.
    Set {
        /// The KME's ID.
        kme: String,
        /// As cut, latency=250 or reset,times=2,on=dec_keys.
        #[arg(required = true)]
        plans: Vec<FaultPlan>,
    },
    /// Removes all plans of a KME.
    Clear {
        /// The KME's ID.
        kme: String,
    },
}

pub(crate) fn fault(arguments: &Arguments) -> CommandResult {
    let (method, path, plans) = match &arguments.action {
        Action::List => ("GET", "/faults".to_owned(), None),
        Action::Kmes => ("GET", "/kmes".to_owned(), None),
        Action::Add { kme, plans } => ("POST", of(kme)?, Some(plans)),
        Action::Set { kme, plans } => ("PUT", of(kme)?, Some(plans)),
        Action::Clear { kme } => ("DELETE", of(kme)?, None),
    };
    let plans = plans.map(|plans| plans.iter().map(ToString::to_string).collect::<Value>());
    let (status, answer) = call(arguments.control, method, &path, plans.as_ref())
        .map_err(|e| other(format!("control address {}: {e}", arguments.control)))?;
    if status != 200 {
        let why = answer["message"].as_str().unwrap_or("without a reason");
        return Err(other(format!("refused with {status}: {why}")));
    }
    say(&format!("{answer:#}\n"));
    Ok(())
}

/// Returns the URL of a KME's faults. The KME's ID becomes part of a request line.
fn of(kme: &str) -> CommandResult<String> {
    if kme.is_empty() || !kme.bytes().all(|c| c.is_ascii_alphanumeric() || b"-_.".contains(&c)) {
        return Err(CommandFailure::Usage(format!("{kme:?} is no KME's ID")));
    }
    Ok(format!("/faults/{kme}"))
}

/// Makes one request on its own connection, which the other end closes.
fn call(
    to: SocketAddr,
    method: &str,
    path: &str,
    body: Option<&Value>,
) -> std::io::Result<(u16, Value)> {
    let mut stream = TcpStream::connect_timeout(&to, TIME)?;
    stream.set_read_timeout(Some(TIME))?;
    stream.set_write_timeout(Some(TIME))?;
    let body = body.map(ToString::to_string).unwrap_or_default();
    let mut request = format!("{method} {path} HTTP/1.1\r\nHost: {to}\r\nX-Kme-Sim: 1\r\n");
    if !body.is_empty() {
        request.push_str("Content-Type: application/json\r\n");
    }
    request.push_str(&format!("Content-Length: {}\r\nConnection: close\r\n\r\n{body}", body.len()));
    stream.write_all(request.as_bytes())?;
    let mut answer = Vec::new();
    stream.take(MAX_ANSWER).read_to_end(&mut answer)?;
    parse(&answer).ok_or_else(|| std::io::Error::other("what answers there is no kme-sim"))
}

fn parse(answer: &[u8]) -> Option<(u16, Value)> {
    let mut headers = [httparse::EMPTY_HEADER; 32];
    let mut head = httparse::Response::new(&mut headers);
    let httparse::Status::Complete(length) = head.parse(answer).ok()? else { return None };
    Some((head.code?, serde_json::from_slice(&answer[length..]).ok()?))
}
