//! Changes faults while the KMEs run, by HTTP on a loopback address.
//!
//! A program that can connect to the address can break the KMEs. Every local program can, including web browsers. A
//! page in a browser must not: a request needs the address itself as `Host` (not a name that a page could rebind), no
//! `Origin`, JSON as its media type, and the header `X-Kme-Sim: 1`. A page cannot send that header without a preflight
//! request, which is never answered with consent.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;

use super::{Error, FaultPlan, Kme, Network};

const MAX_CONNECTIONS: usize = 16;
const MAX_HEAD: usize = 8 << 10;
const MAX_BODY: usize = 64 << 10;
const MAX_HEADERS: usize = 32;
/// Most plans that wait at one KME.
const MAX_PLANS: usize = 256;
/// Time from the connection to the last byte of the answer.
const TIME: Duration = Duration::from_secs(5);

/// An address at which the faults of a running [`Network`] can be read and changed.
///
/// | request | does |
/// | --- | --- |
/// | `GET /kmes` | the KMEs: `id`, `url` and `counters` of each |
/// | `GET /faults` | the plans that wait at each KME |
/// | `PUT /faults/KME` | replaces the plans of a KME by an array of plans, as texts |
/// | `POST /faults/KME` | adds an array of plans |
/// | `DELETE /faults/KME` | removes all plans |
///
/// The answer to a change contains the KME's plans after it. Every request must have `X-Kme-Sim: 1`.
#[derive(Debug)]
pub struct Control {
    listener: TcpListener,
    addr: SocketAddr,
}

impl Control {
    /// Listens on `bind`; port 0 is any free one.
    ///
    /// # Errors
    /// [`Error::Layout`] if `bind` is not a loopback address, [`Error::Io`] if it is in use.
    pub async fn bind(bind: SocketAddr) -> Result<Self, Error> {
        if !bind.ip().is_loopback() {
            return Err(Error::Layout(format!(
                "control address {bind}: it must be a loopback address, as 127.0.0.1:8400"
            )));
        }
        let listener = TcpListener::bind(bind).await.map_err(Error::io(bind))?;
        let addr = listener.local_addr().map_err(Error::io(bind))?;
        Ok(Self { listener, addr })
    }

    /// Returns the address on which it listens.
    #[must_use]
    pub fn addr(&self) -> SocketAddr {
        self.addr
    }

    /// Serves until the future is dropped, which also ends its connections.
    pub async fn serve(self, network: Arc<Network>) {
        let permits = Arc::new(Semaphore::new(MAX_CONNECTIONS));
        let mut connections = JoinSet::new();
        loop {
            while connections.try_join_next().is_some() {}
            let Ok(permit) = Arc::clone(&permits).acquire_owned().await else { return };
            let Ok((stream, _)) = self.listener.accept().await else {
                tokio::time::sleep(Duration::from_millis(50)).await;
                continue;
            };
            let (network, addr) = (Arc::clone(&network), self.addr);
            connections.spawn(async move {
                let _permit = permit;
                // A caller that breaks off affects only itself.
                let _ = tokio::time::timeout(TIME, connection(stream, addr, &network)).await;
            });
        }
    }
}

/// Serves the one request of a connection.
async fn connection(
    mut stream: TcpStream,
    addr: SocketAddr,
    network: &Network,
) -> std::io::Result<()> {
    let (status, body) = match read(&mut stream).await? {
        Ok(request) => match allowed(&request, addr) {
            Ok(()) => answer(&request, network),
            Err(why) => error(403, why),
        },
        Err((status, why)) => error(status, why),
    };
    let body = body.to_string();
    let head = format!(
        "HTTP/1.1 {status} {}\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\
         Cache-Control: no-store\r\nConnection: close\r\n\r\n",
        reason(status),
        body.len()
    );
    stream.write_all(head.as_bytes()).await?;
    stream.write_all(body.as_bytes()).await?;
    stream.shutdown().await?;
    // Reads what the caller still sends, because closing with unread bytes would reset the connection and lose the
    // answer.
    let mut sink = [0; 4096];
    while stream.read(&mut sink).await? > 0 {}
    Ok(())
}

struct Request {
    method: String,
    path: String,
    /// The header names are in lower case.
    headers: BTreeMap<String, String>,
    body: Vec<u8>,
}

type Answer = (u16, Value);

fn error(status: u16, why: impl Into<String>) -> Answer {
    (status, json!({ "message": why.into() }))
}

/// Reads a request. The inner error is the status and the reason of a refusal.
async fn read(stream: &mut TcpStream) -> std::io::Result<Result<Request, (u16, &'static str)>> {
    let mut buffer = Vec::new();
    let end = loop {
        if let Some(at) = buffer.windows(4).position(|window| window == b"\r\n\r\n") {
            break at + 4;
        }
        if buffer.len() > MAX_HEAD {
            return Ok(Err((431, "the head is too long")));
        }
        if stream.read_buf(&mut buffer).await? == 0 {
            return Err(std::io::ErrorKind::UnexpectedEof.into());
        }
    };
    let (mut request, length) = match head(&buffer[..end]) {
        Ok(read) => read,
        Err(why) => return Ok(Err((400, why))),
    };
    if length > MAX_BODY {
        return Ok(Err((413, "the body is too long")));
    }
    while buffer.len() < end + length {
        if stream.read_buf(&mut buffer).await? == 0 {
            return Err(std::io::ErrorKind::UnexpectedEof.into());
        }
    }
    request.body = buffer[end..end + length].to_vec();
    Ok(Ok(request))
}

/// Parses a head. Also returns the length of the body.
fn head(bytes: &[u8]) -> Result<(Request, usize), &'static str> {
    let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
    let mut parsed = httparse::Request::new(&mut headers);
    let whole = parsed.parse(bytes).map_err(|_| "the head is not HTTP")?.is_complete();
    let (Some(method), Some(path), true) = (parsed.method, parsed.path, whole) else {
        return Err("the head is not HTTP");
    };
    let mut headers = BTreeMap::new();
    for header in parsed.headers.iter() {
        let value = std::str::from_utf8(header.value).map_err(|_| "a header is not UTF-8")?;
        let name = header.name.to_ascii_lowercase();
        if headers.insert(name, value.trim().to_owned()).is_some() {
            return Err("a header is there twice");
        }
    }
    if headers.contains_key("transfer-encoding") {
        return Err("a body needs a Content-Length");
    }
    let length = match headers.get("content-length") {
        None => 0,
        Some(text) if text.bytes().all(|c| c.is_ascii_digit()) => {
            text.parse().map_err(|_| "Content-Length is no length")?
        }
        Some(_) => return Err("Content-Length is no length"),
    };
    let (method, path) = (method.to_owned(), path.to_owned());
    Ok((Request { method, path, headers, body: Vec::new() }, length))
}

/// Refuses a request that a page in a browser could have sent.
fn allowed(request: &Request, addr: SocketAddr) -> Result<(), String> {
    let header = |name: &str| request.headers.get(name).map(String::as_str);
    if header("host") != Some(&addr.to_string()) {
        return Err(format!("Host must be {addr}"));
    }
    if header("origin").is_some() {
        return Err("no web page may call this".into());
    }
    if header("x-kme-sim") != Some("1") {
        return Err("the header X-Kme-Sim: 1 is missing".into());
    }
    let has_body = matches!(request.method.as_str(), "PUT" | "POST") || !request.body.is_empty();
    if has_body && header("content-type") != Some("application/json") {
        return Err("Content-Type must be application/json".into());
    }
    Ok(())
}

fn answer(request: &Request, network: &Network) -> Answer {
    match (request.method.as_str(), request.path.as_str()) {
        ("GET", "/kmes") => (200, network.kmes().iter().map(description).collect()),
        ("GET", "/faults") => {
            let all = network.kmes().iter().map(|kme| (kme.id().to_owned(), plans(kme)));
            (200, Value::Object(all.collect()))
        }
        (_, "/kmes" | "/faults") => error(405, "method not allowed"),
        (method, path) => match path.strip_prefix("/faults/") {
            Some(id) => match network.kme(id) {
                Some(kme) => change(method, kme, &request.body).unwrap_or_else(|refused| refused),
                None => error(404, format!("there is no KME {id:?}")),
            },
            None => error(404, "no such resource"),
        },
    }
}

fn change(method: &str, kme: &Kme, body: &[u8]) -> Result<Answer, Answer> {
    let keep = match method {
        "GET" => return Ok((200, plans(kme))),
        "DELETE" => {
            kme.clear_faults();
            return Ok((200, plans(kme)));
        }
        "PUT" => false,
        "POST" => true,
        _ => return Err(error(405, "method not allowed")),
    };
    let texts: Vec<String> = serde_json::from_slice(body)
        .map_err(|e| error(400, format!("the body is no array of plans: {e}")))?;
    let new: Vec<FaultPlan> = texts
        .iter()
        .map(|text| text.parse())
        .collect::<Result<_, _>>()
        .map_err(|why| error(400, why))?;
    let before = if keep { kme.plans().len() } else { 0 };
    if before + new.len() > MAX_PLANS {
        return Err(error(400, format!("more than {MAX_PLANS} plans would wait at {}", kme.id())));
    }
    if !keep {
        kme.clear_faults();
    }
    new.into_iter().for_each(|plan| kme.plan(plan));
    Ok((200, plans(kme)))
}

fn plans(kme: &Kme) -> Value {
    kme.plans().iter().map(ToString::to_string).collect()
}

fn description(kme: &Kme) -> Value {
    let counters = kme.counters();
    json!({
        "id": kme.id(),
        "url": kme.url(),
        "counters": {
            "status_calls": counters.status_calls,
            "enc_keys_calls": counters.enc_keys_calls,
            "dec_keys_calls": counters.dec_keys_calls,
            "keys_to_masters": counters.keys_to_masters,
            "keys_to_slaves": counters.keys_to_slaves,
            "refused": counters.refused,
        },
    })
}

fn reason(status: u16) -> &'static str {
    match status {
        200 => "OK",
        400 => "Bad Request",
        403 => "Forbidden",
        404 => "Not Found",
        405 => "Method Not Allowed",
        413 => "Content Too Large",
        _ => "Request Header Fields Too Large",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn heads_that_are_ambiguous_are_refused() {
        for bad in [
            "\r\n\r\n",
            "GET\r\n\r\n",
            "PUT /faults/a HTTP/1.1\r\nContent-Length: +1\r\n\r\n",
            "PUT /faults/a HTTP/1.1\r\nContent-Length: 1\r\ncontent-length: 1\r\n\r\n",
            "PUT /faults/a HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n",
            "PUT /faults/a HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
            "PUT /faults/a HTTP/1.1\r\nno colon\r\n\r\n",
        ] {
            assert!(head(bad.as_bytes()).is_err(), "{bad:?}");
        }
        assert_eq!(head(b"GET /kmes HTTP/1.1\r\ncontent-length: 7\r\n\r\n").unwrap().1, 7);
    }

    proptest! {
        #[test]
        fn any_head_is_parsed_without_panic(bytes: Vec<u8>) {
            let _ = head(&bytes);
        }
    }
}
