//! One attempt of a call: sends a request, reads a bounded answer, and classifies failures.

use std::time::Duration;

use bytes::Bytes;
use reqwest::header::{ACCEPT, ACCEPT_ENCODING, CONTENT_ENCODING, CONTENT_TYPE, RETRY_AFTER};
use reqwest::{Method, Response, StatusCode, Url, Version};
use serde::Serialize;
use tokio::time::{Instant, timeout};

use crate::builder::Limits;
use crate::secret::SecretBuf;
use crate::{Error, Quirks, parse, tls};

/// The answer of status 200; it is zeroized on drop.
pub(crate) type Body = SecretBuf;

/// Largest body of another status that is read for its message, in bytes.
const MAX_ERROR_BODY: usize = 64 << 10;

/// The three methods of the interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Call {
    Status,
    EncKeys,
    DecKeys,
}

impl Call {
    /// Wraps a failure after which keys may be consumed. A status consumes none.
    pub(crate) fn consumed(self, cause: Error) -> Error {
        let call = match self {
            Self::Status => return cause,
            Self::EncKeys => "enc_keys",
            Self::DecKeys => "dec_keys",
        };
        Error::KeyPossiblyConsumed { call, cause: Box::new(cause) }
    }
}

/// A request that can be sent more than once.
pub(crate) struct Prepared {
    method: Method,
    url: Url,
    body: Option<Bytes>,
}

pub(crate) struct ExchangeFailure {
    pub(crate) error: Error,
    /// True if the KME may have served the request in spite of the error.
    pub(crate) ambiguous: bool,
}

impl ExchangeFailure {
    fn clear(error: Error) -> Self {
        Self { error, ambiguous: false }
    }

    fn ambiguous(error: Error) -> Self {
        Self { error, ambiguous: true }
    }
}

impl Prepared {
    pub(crate) fn get(url: Url) -> Self {
        Self { method: Method::GET, url, body: None }
    }

    pub(crate) fn post(url: Url, json: &impl Serialize) -> Self {
        let body = serde_json::to_vec(json).expect("text, numbers and JSON have a JSON form");
        Self { method: Method::POST, url, body: Some(body.into()) }
    }

    pub(crate) async fn attempt(
        &self,
        http: &reqwest::Client,
        kme: &str,
        connect_timeout: Duration,
        time: Duration,
        limits: &Limits,
    ) -> Result<Body, ExchangeFailure> {
        // Without the second header, any content coding would be acceptable (RFC 7231, 5.3.4).
        let mut request = http
            .request(self.method.clone(), self.url.clone())
            .header(ACCEPT, "application/json")
            .header(ACCEPT_ENCODING, "identity");
        if let Some(body) = &self.body {
            request = request.header(CONTENT_TYPE, "application/json").body(body.clone());
        }
        let began = Instant::now();
        // Connecting has its own, shorter timeout, so the request is assumed to have left.
        let late = || ExchangeFailure::ambiguous(Error::Timeout { phase: "answer", after: time });
        let response = timeout(time, request.send())
            .await
            .map_err(|_| late())?
            .map_err(|e| send_failure(&e, kme, connect_timeout))?;
        let left = time.saturating_sub(began.elapsed());
        if response.status() != StatusCode::OK {
            return Err(refused(response, left).await);
        }
        timeout(left, receive(response, limits)).await.map_err(|_| late())?
    }
}

/// Classifies a failure before there was an answer.
fn send_failure(error: &reqwest::Error, kme: &str, connect_timeout: Duration) -> ExchangeFailure {
    let connected = !error.is_connect();
    if let Some((refused_by, reason)) =
        tls::tls_error(error).and_then(|tls| tls::refusal(tls, connected))
    {
        return ExchangeFailure::clear(Error::Tls { kme: kme.to_owned(), refused_by, reason });
    }
    if connected {
        return ExchangeFailure::ambiguous(Error::Interrupted { reason: innermost(error) });
    }
    ExchangeFailure::clear(if error.is_timeout() {
        Error::Timeout { phase: "connect", after: connect_timeout }
    } else {
        Error::Unreachable { kme: kme.to_owned(), reason: innermost(error) }
    })
}

/// Returns the innermost reason of the chain: the outer ones repeat the URL.
fn innermost(error: &reqwest::Error) -> String {
    let mut reason: &dyn std::error::Error = error;
    while let Some(source) = reason.source() {
        reason = source;
    }
    reason.to_string()
}

async fn receive(mut response: Response, limits: &Limits) -> Result<Body, ExchangeFailure> {
    let quirks = limits.quirks;
    if response.version() < Version::HTTP_11 && !quirks.contains(Quirks::HTTP_1_0) {
        return Err(ExchangeFailure::ambiguous(Error::Malformed {
            what: "HTTP version".to_owned(),
            reason: "is older than 1.1, clause 5.1 (quirk http-1.0 tolerates it)".to_owned(),
        }));
    }
    if !quirks.contains(Quirks::ANY_MEDIA_TYPE) && !is_json(&response) {
        return Err(ExchangeFailure::ambiguous(Error::Malformed {
            what: "Content-Type".to_owned(),
            reason: "is not application/json, clause 5.1 (quirk any-media-type tolerates it)"
                .to_owned(),
        }));
    }
    let coding = response.headers().get(CONTENT_ENCODING);
    if coding.is_some_and(|coding| !coding.as_bytes().eq_ignore_ascii_case(b"identity")) {
        return Err(ExchangeFailure::ambiguous(Error::Malformed {
            what: "Content-Encoding".to_owned(),
            reason: "is not identity, the only one that was asked for".to_owned(),
        }));
    }
    read_body(&mut response, limits.max_body).await.map_err(ExchangeFailure::ambiguous)
}

fn is_json(response: &Response) -> bool {
    let value = response.headers().get(CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let media_type = value.and_then(|value| value.split(';').next()).unwrap_or_default();
    media_type.trim().eq_ignore_ascii_case("application/json")
}

/// Reads at most `limit` bytes. Content-Length is only a hint for the first allocation.
async fn read_body(response: &mut Response, limit: usize) -> Result<Body, Error> {
    let expected = response.content_length().and_then(|length| usize::try_from(length).ok());
    if expected.is_some_and(|length| length > limit) {
        return Err(Error::BodyTooLarge { limit });
    }
    // Header values share memory with the body's first chunk, which can be cleared only if nothing
    // else refers to it.
    response.headers_mut().clear();
    response.extensions_mut().clear();
    let mut body = SecretBuf::new(expected.unwrap_or(16 << 10), limit);
    let mut held = Held(None);
    loop {
        let chunk = match response.chunk().await {
            Ok(Some(chunk)) => chunk,
            Ok(None) => {
                held.settle().await;
                return Ok(body);
            }
            Err(e) => return Err(Error::Interrupted { reason: innermost(&e) }),
        };
        let kept = body.extend(&chunk);
        held.replace(chunk);
        kept.map_err(|_| Error::BodyTooLarge { limit })?;
    }
}

/// The chunk that was read last. As long as it is held, hyper cannot reuse its memory and takes
/// other memory for the next read. So when the next chunk comes, this one either is the last
/// reference to its memory, or shares it with the next chunk, which then keeps the memory.
struct Held(Option<Bytes>);

impl Held {
    fn replace(&mut self, next: Bytes) {
        if let Some(last) = self.0.replace(next) {
            clear(last);
        }
    }

    /// Yields a few times, so that the connection's task begins its next read, for which it takes
    /// other memory. Only then can the last chunk be cleared. If that task runs on another thread,
    /// it may still be late.
    async fn settle(&self) {
        for _ in 0..16 {
            if self.0.as_ref().is_none_or(Bytes::is_unique) {
                return;
            }
            tokio::task::yield_now().await;
        }
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        if let Some(last) = self.0.take() {
            clear(last);
        }
    }
}

/// Zeroizes all the memory that contains a chunk, if nothing else refers to it.
fn clear(chunk: Bytes) {
    if let Ok(mut own) = chunk.try_into_mut() {
        own.clear();
        // Reserving more than the capacity moves the start back to the beginning of the memory.
        let _ = own.try_reclaim(own.capacity() + 1);
        own.resize(own.capacity(), 0);
        zeroize::optimization_barrier(&own[..]);
    }
}

/// Classifies an answer with a status other than 200. The status suffices, whatever happens to the
/// body.
async fn refused(mut response: Response, left: Duration) -> ExchangeFailure {
    let status = response.status();
    let retry_after = response
        .headers()
        .get(RETRY_AFTER)
        .and_then(|value| value.to_str().ok()?.trim().parse().ok())
        .map(Duration::from_secs);
    let body = timeout(left, read_body(&mut response, MAX_ERROR_BODY)).await;
    let body = body.ok().and_then(Result::ok);
    let parse::ErrorAnswer { message, details } =
        body.map(|body| parse::error_answer(&body)).unwrap_or_default();
    match status.as_u16() {
        400 => ExchangeFailure::clear(Error::BadRequest { message, details }),
        401 => ExchangeFailure::clear(Error::Unauthorized { message, details }),
        503 => ExchangeFailure::clear(Error::Unavailable { message, details, retry_after }),
        // A redirect or a refusal has served nothing; a gateway's 502 or a KME's 500 may have.
        code @ (300..=499) => ExchangeFailure::clear(Error::Status { code, message }),
        code => ExchangeFailure::ambiguous(Error::Status { code, message }),
    }
}
