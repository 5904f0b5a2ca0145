//! The part of HTTP/1.1 that this interface needs: requests whose body has a Content-Length or is chunked, one after
//! the other or pipelined, and answers that can be wrong on purpose.

use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use zeroize::{Zeroize, Zeroizing};

use super::{chunks, fault::Fault};

pub(super) const MAX_HEAD: usize = 16 << 10;
pub(super) const MAX_BODY: usize = 1 << 20;
pub(super) const TOO_LARGE: NoRequest = NoRequest::Refused(413, "the body is larger than 1 MiB");
/// Size in bytes above which an empty buffer is freed.
const KEPT_BUFFER: usize = 32 << 10;

#[derive(Debug)]
pub(super) struct Request {
    pub(super) method: String,
    /// The path without the query.
    pub(super) path: String,
    pub(super) query: String,
    /// True if the body is labelled application/json.
    pub(super) json: bool,
    /// True if the client wants the connection closed after the answer.
    pub(super) close: bool,
    pub(super) body: Vec<u8>,
}

/// The reason why there is no request.
pub(super) enum NoRequest {
    /// The client has finished, or is gone.
    Closed,
    /// The input is not accepted: the status and the message of the refusal.
    Refused(u16, &'static str),
}

pub(super) struct Answer {
    pub(super) status: u16,
    pub(super) body: Zeroizing<String>,
    /// Seconds for the header Retry-After.
    pub(super) retry_after: Option<u64>,
    /// True if the connection is closed after the answer.
    pub(super) close: bool,
}

/// Reads one request. `buffer` keeps the bytes after it. If `strict`, a body needs a Content-Length.
pub(super) async fn read<S: AsyncRead + AsyncWrite + Unpin>(
    stream: &mut S,
    buffer: &mut Vec<u8>,
    strict: bool,
) -> Result<Request, NoRequest> {
    let mut searched = 0;
    let end = loop {
        // The end of the head may have begun in the part that was already searched.
        let from = usize::saturating_sub(searched, 3);
        if let Some(at) = buffer[from..].windows(4).position(|window| window == b"\r\n\r\n") {
            break from + at;
        }
        if buffer.len() > MAX_HEAD {
            return Err(NoRequest::Refused(431, "the head is larger than 16 KiB"));
        }
        searched = buffer.len();
        if stream.read_buf(buffer).await.unwrap_or(0) == 0 {
            return Err(NoRequest::Closed);
        }
    };
    let Head { mut request, length, coding, waits } = head(&buffer[..end])
        .ok_or(NoRequest::Refused(400, "the head is not one of HTTP/1.1 with one Host"))?;
    let chunked = coding.is_some();
    if chunked && strict {
        return Err(NoRequest::Refused(411, "a body needs a Content-Length"));
    }
    if coding.is_some_and(|coding| !coding.eq_ignore_ascii_case("chunked")) {
        return Err(NoRequest::Refused(501, "a body may be chunked, and coded in no other way"));
    }
    if length > MAX_BODY {
        return Err(TOO_LARGE);
    }
    let head = end + 4;
    let total = head + length;
    if waits && (buffer.len() < total || (chunked && buffer.len() == head)) {
        let go_on = async {
            stream.write_all(b"HTTP/1.1 100 Continue\r\n\r\n").await?;
            stream.flush().await
        };
        go_on.await.map_err(|_| NoRequest::Closed)?;
    }
    let behind = if chunked {
        let (body, behind) = chunks::read(stream, buffer, head).await?;
        request.body = body;
        behind
    } else {
        while buffer.len() < total {
            if stream.read_buf(buffer).await.unwrap_or(0) == 0 {
                return Err(NoRequest::Closed);
            }
        }
        request.body = buffer[head..total].to_vec();
        total
    };
    buffer.drain(..behind);
    if buffer.is_empty() && buffer.capacity() > KEPT_BUFFER {
        *buffer = Vec::new();
    }
    Ok(request)
}

struct Head {
    request: Request,
    /// The length of the body.
    length: usize,
    /// The transfer codings; the last one determines where the body ends.
    coding: Option<String>,
    /// True if the client waits for 100 Continue before it sends the body (RFC 9110, 10.1.1).
    waits: bool,
}

/// Parses a request's head. A request of HTTP/1.1 must name one host (RFC 9112, 3.2).
fn head(bytes: &[u8]) -> Option<Head> {
    let text = std::str::from_utf8(bytes).ok()?;
    let mut lines = text.split("\r\n");
    let mut first = lines.next()?.split(' ');
    let (method, target, version) = (first.next()?, first.next()?, first.next()?);
    if first.next().is_some() || version != "HTTP/1.1" || !target.starts_with('/') {
        return None;
    }
    let mut length = None;
    let (mut hosts, mut media, mut close) = (0, None, false);
    let (mut coding, mut waits) = (None::<String>, false);
    for line in lines {
        let (name, value) = line.split_once(':')?;
        // No space before the colon, and no folded line (RFC 9112, 5.1 and 5.2).
        if name.is_empty() || name.contains([' ', '\t']) {
            return None;
        }
        if name.eq_ignore_ascii_case("content-length") {
            let value = value.trim();
            if length.is_some() || value.is_empty() || !value.bytes().all(|c| c.is_ascii_digit()) {
                return None;
            }
            length = Some(value.parse().ok()?);
        }
        if name.eq_ignore_ascii_case("transfer-encoding") {
            let value = value.trim();
            // Several headers of this name form one list (RFC 9110, 5.3).
            coding =
                Some(coding.map_or_else(|| value.to_owned(), |first| format!("{first}, {value}")));
        }
        waits |= name.eq_ignore_ascii_case("expect")
            && value.trim().eq_ignore_ascii_case("100-continue");
        if name.eq_ignore_ascii_case("host") {
            hosts += 1;
        }
        if name.eq_ignore_ascii_case("content-type") && media.replace(value).is_some() {
            return None;
        }
        if name.eq_ignore_ascii_case("connection") {
            close |= value.split(',').any(|option| option.trim().eq_ignore_ascii_case("close"));
        }
    }
    // A body must not have both a coding and a length (RFC 9112, 6.1).
    if hosts != 1 || (coding.is_some() && length.is_some()) {
        return None;
    }
    let media = media.and_then(|media| media.split(';').next()).unwrap_or_default().trim();
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    let request = Request {
        method: method.to_owned(),
        path: path.to_owned(),
        query: query.to_owned(),
        json: media.eq_ignore_ascii_case("application/json"),
        close,
        body: Vec::new(),
    };
    Some(Head { request, length: length.unwrap_or(0), coding, waits })
}

/// Decodes percent-encoding; `None` if it is malformed or not UTF-8.
pub(super) fn percent_decode(text: &str) -> Option<String> {
    let mut out = Vec::with_capacity(text.len());
    let mut bytes = text.bytes();
    while let Some(byte) = bytes.next() {
        out.push(match byte {
            b'%' => {
                let digit = |c: u8| char::from(c).to_digit(16);
                let (high, low) = (digit(bytes.next()?)?, digit(bytes.next()?)?);
                u8::try_from(high << 4 | low).ok()?
            }
            plain => plain,
        });
    }
    String::from_utf8(out).ok()
}

/// Writes an answer, with the given fault. Returns whether the connection stays open.
pub(super) async fn write<S: AsyncWrite + Unpin>(
    stream: &mut S,
    answer: &Answer,
    fault: Option<&Fault>,
) -> std::io::Result<bool> {
    let body: &str = if fault == Some(&Fault::Garbage) { "{\"keys\":[}" } else { &answer.body };
    let length = match fault {
        Some(Fault::LyingLength) => u64::MAX / 2,
        _ => body.len() as u64,
    };
    let version = if fault == Some(&Fault::Http10) { "HTTP/1.0" } else { "HTTP/1.1" };
    let media =
        if fault == Some(&Fault::WrongMediaType) { "text/plain" } else { "application/json" };
    let status = answer.status;
    let mut head = format!("{version} {status} {}\r\nContent-Type: {media}\r\n", reason(status));
    if let Some(seconds) = answer.retry_after {
        head.push_str(&format!("Retry-After: {seconds}\r\n"));
    }
    if answer.close {
        head.push_str("Connection: close\r\n");
    }
    match fault {
        Some(Fault::Endless) => head.push_str("Transfer-Encoding: chunked\r\n\r\n"),
        Some(Fault::Http10) => head.push_str("\r\n"),
        _ => head.push_str(&format!("Content-Length: {length}\r\n\r\n")),
    }
    // One write, so that an answer is one TLS record if it fits.
    let mut bytes = Zeroizing::new(Vec::with_capacity(head.len() + body.len()));
    bytes.extend_from_slice(head.as_bytes());
    match fault {
        Some(Fault::Endless) => {
            stream.write_all(&bytes).await?;
            let chunk = format!("1000\r\n{}\r\n", " ".repeat(0x1000));
            loop {
                stream.write_all(chunk.as_bytes()).await?;
            }
        }
        Some(Fault::CutAnswer) => {
            bytes.extend_from_slice(&body.as_bytes()[..body.len() / 2]);
            stream.write_all(&bytes).await?;
            stream.flush().await?;
            return Ok(false);
        }
        Some(Fault::Drip(pause)) => {
            bytes.extend_from_slice(body.as_bytes());
            drip(stream, &bytes, *pause).await?;
        }
        _ => {
            bytes.extend_from_slice(body.as_bytes());
            stream.write_all(&bytes).await?;
        }
    }
    bytes.zeroize();
    stream.flush().await?;
    Ok(!answer.close && !matches!(fault, Some(Fault::LyingLength | Fault::Http10)))
}

async fn drip<S: AsyncWrite + Unpin>(
    stream: &mut S,
    bytes: &[u8],
    pause: Duration,
) -> std::io::Result<()> {
    for byte in bytes {
        stream.write_all(std::slice::from_ref(byte)).await?;
        stream.flush().await?;
        tokio::time::sleep(pause).await;
    }
    Ok(())
}

fn reason(status: u16) -> &'static str {
    match status {
        200 => "OK",
        400 => "Bad Request",
        401 => "Unauthorized",
        404 => "Not Found",
        405 => "Method Not Allowed",
        411 => "Length Required",
        413 => "Content Too Large",
        431 => "Request Header Fields Too Large",
        501 => "Not Implemented",
        503 => "Service Unavailable",
        _ => "Status",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn heads_that_are_ambiguous_are_refused() {
        for bad in [
            "",
            "GET",
            "GET / HTTP/1.0",
            "GET / HTTP/1.1 x",
            "GET http://x/ HTTP/1.1",
            "GET / HTTP/1.1",
            "GET / HTTP/1.1\r\nHost: a\r\nHost: a",
            "POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 1\r\nContent-Length: 1",
            "POST / HTTP/1.1\r\nHost: a\r\nContent-Length: +1",
            "POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\nContent-Length: 1",
            "POST / HTTP/1.1\r\nHost: a\r\n Content-Length: 1",
            "POST / HTTP/1.1\r\nHost: a\r\nContent-Length : 1",
            "POST / HTTP/1.1\r\nHost: a\r\nContent-Type: a/b\r\nContent-Type: a/b",
            "POST / HTTP/1.1\r\nHost: a\r\nno colon",
        ] {
            assert!(head(bad.as_bytes()).is_none(), "{bad:?}");
        }
        let text = b"POST /a?b=c HTTP/1.1\r\nhost: a\r\ncontent-length: 7";
        let Head { request, length, .. } = head(text).unwrap();
        assert_eq!((request.path.as_str(), request.query.as_str(), length), ("/a", "b=c", 7));
        assert!(!request.json && !request.close);
    }

    #[test]
    fn media_type_and_close_are_read_in_any_spelling() {
        let text = "POST / HTTP/1.1\r\nHost: a\r\nCONTENT-TYPE: Application/JSON ; charset=utf-8\
                    \r\nConnection: keep-alive, Close";
        let request = head(text.as_bytes()).unwrap().request;
        assert!(request.json && request.close);
        let other = text.replace("JSON", "json-seq").replace("Close", "x-close");
        let request = head(other.as_bytes()).unwrap().request;
        assert!(!request.json && !request.close);
    }

    #[test]
    fn percent_encoding_is_undone() {
        assert_eq!(percent_decode("a%2Fb%c3%A9").as_deref(), Some("a/bé"));
        for bad in ["%", "%2", "%zz", "%ff"] {
            assert_eq!(percent_decode(bad), None);
        }
    }

    proptest! {
        #[test]
        fn any_head_is_parsed_without_panic(bytes: Vec<u8>, text: String) {
            let _ = head(&bytes);
            let _ = percent_decode(&text);
        }
    }
}
