//! Faults on demand: the possible faults of a KME, and their textual form.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

/// A fault of a KME in its handling of a request. [`Kme::inject`](super::Kme::inject) injects it;
/// [`Kme::plan`](super::Kme::plan) gives more control over when it happens.
///
/// Unless stated otherwise, the request is served first, so that the requested keys are consumed.
///
/// Its text is a name, with a value for some faults: `cut`, `latency=250`, `status=500`.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Fault {
    /// `handshake-refused`: the TLS handshake is refused with the alert handshake_failure. Nothing
    /// is served. Affects only new connections.
    HandshakeRefused,
    /// `handshake-dropped`: the TCP connection is closed before the TLS handshake, without an
    /// alert. Nothing is served. Affects only new connections.
    HandshakeDropped,
    /// `certificate-expired`: the KME shows an expired certificate. Affects only new connections. A
    /// client that accepts the certificate is served.
    CertificateExpired,
    /// `certificate-not-yet-valid`: the KME shows a certificate that is not valid yet. Affects only
    /// new connections. A client that accepts the certificate is served.
    CertificateNotYetValid,
    /// `latency=MILLISECONDS`: the answer is delayed by this time, in addition to other faults of
    /// the request.
    Latency(Duration),
    /// `silence`: the answer never comes.
    Silence,
    /// `drip=MILLISECONDS`: the answer comes one byte at a time, with this pause between two bytes.
    Drip(Duration),
    /// `empty`: 503, as from an empty store. Nothing is served.
    Empty,
    /// `busy=SECONDS`: 503 with a Retry-After of this time. Nothing is served.
    Busy(u64),
    /// `status=CODE`: another status, without a JSON body. Nothing is served.
    Status(u16),
    /// `reset`: the connection is reset after the request.
    ResetAfterRequest,
    /// `cut`: the connection is closed in the middle of the answer's body.
    CutAnswer,
    /// `garbage`: the answer's body is no JSON.
    Garbage,
    /// `endless`: the answer's body never ends, and has no Content-Length.
    Endless,
    /// `lying-length`: the Content-Length is larger than any client should accept.
    LyingLength,
    /// `wrong-length`: keys are one byte too short.
    WrongLength,
    /// `repeat-key-id`: all keys of an answer have the first one's key_ID.
    RepeatKeyId,
    /// `reuse-key-id`: the first key of an answer to `enc_keys` has a key_ID that the KME gave in
    /// an earlier answer, namely that of its last key, if there is one.
    ReuseKeyId,
    /// `key-kept`: `dec_keys` gives keys but keeps them, so that they can be given again.
    KeyKept,
    /// `wrong-key`: the first key of an answer differs from the key that the other SAE gets under
    /// its key_ID.
    WrongKey,
    /// `key-missing`: the first key is missing.
    KeyMissing,
    /// `upper-case-ids`: key_IDs are in upper case.
    UpperCaseIds,
    /// `other-ids`: key_IDs that were not requested.
    OtherIds,
    /// `media-type`: the answer is labelled `text/plain`.
    WrongMediaType,
    /// `http-1.0`: the answer is HTTP/1.0 and ends with the connection.
    Http10,
}

/// What a fault affects.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Meets {
    Connection,
    Request,
}

/// The faults without a value, by name.
const PLAIN: [(&str, Fault); 20] = [
    ("handshake-refused", Fault::HandshakeRefused),
    ("handshake-dropped", Fault::HandshakeDropped),
    ("certificate-expired", Fault::CertificateExpired),
    ("certificate-not-yet-valid", Fault::CertificateNotYetValid),
    ("silence", Fault::Silence),
    ("empty", Fault::Empty),
    ("reset", Fault::ResetAfterRequest),
    ("cut", Fault::CutAnswer),
    ("garbage", Fault::Garbage),
    ("endless", Fault::Endless),
    ("lying-length", Fault::LyingLength),
    ("wrong-length", Fault::WrongLength),
    ("repeat-key-id", Fault::RepeatKeyId),
    ("reuse-key-id", Fault::ReuseKeyId),
    ("key-kept", Fault::KeyKept),
    ("wrong-key", Fault::WrongKey),
    ("key-missing", Fault::KeyMissing),
    ("upper-case-ids", Fault::UpperCaseIds),
    ("other-ids", Fault::OtherIds),
    ("media-type", Fault::WrongMediaType),
];
const HTTP_1_0: &str = "http-1.0";
/// The faults with a value, as messages show them.
const WITH_VALUE: &str = "latency=MILLISECONDS, drip=MILLISECONDS, busy=SECONDS, status=CODE";
/// One day. A longer pause is a typing error.
const MAX_PAUSE_MS: u64 = 86_400_000;

impl Fault {
    pub(super) fn meets(&self) -> Meets {
        match self {
            Self::HandshakeRefused
            | Self::HandshakeDropped
            | Self::CertificateExpired
            | Self::CertificateNotYetValid => Meets::Connection,
            _ => Meets::Request,
        }
    }

    /// Returns every way to write a fault, for messages.
    pub(super) fn all() -> String {
        let plain: Vec<_> = PLAIN.iter().map(|(name, _)| *name).chain([HTTP_1_0]).collect();
        format!("{}, {WITH_VALUE}", plain.join(", "))
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Latency(time) => write!(f, "latency={}", time.as_millis()),
            Self::Drip(pause) => write!(f, "drip={}", pause.as_millis()),
            Self::Busy(seconds) => write!(f, "busy={seconds}"),
            Self::Status(code) => write!(f, "status={code}"),
            Self::Http10 => f.write_str(HTTP_1_0),
            plain => {
                let known = PLAIN.iter().find(|(_, fault)| fault == plain);
                f.write_str(known.map_or("unnamed", |(name, _)| name))
            }
        }
    }
}

impl FromStr for Fault {
    type Err = String;

    /// Parses a fault. The error contains the text and the accepted values.
    fn from_str(text: &str) -> Result<Self, String> {
        let unknown = || format!("{text:?} is no fault; there are: {}", Self::all());
        let Some((name, value)) = text.split_once('=') else {
            if text == HTTP_1_0 {
                return Ok(Self::Http10);
            }
            let known = PLAIN.iter().find(|(name, _)| *name == text);
            return known.map(|(_, fault)| fault.clone()).ok_or_else(unknown);
        };
        let number = |max: u64| {
            let number = value.parse::<u64>().ok().filter(|number| *number <= max);
            number.ok_or_else(|| format!("{text:?}: the value is a whole number up to {max}"))
        };
        Ok(match name {
            "latency" => Self::Latency(Duration::from_millis(number(MAX_PAUSE_MS)?)),
            "drip" => Self::Drip(Duration::from_millis(number(MAX_PAUSE_MS)?)),
            "busy" => Self::Busy(number(MAX_PAUSE_MS)?),
            "status" => match u16::try_from(number(599)?) {
                Ok(code @ 200..) => Self::Status(code),
                _ => return Err(format!("{text:?}: status codes are 200 to 599")),
            },
            _ => return Err(unknown()),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_fault_text_is_refused_with_the_valid_faults() {
        for wrong in [
            "",
            "Cut",
            "cut ",
            "cut=1",
            "latency",
            "latency=",
            "latency=-1",
            "latency=1s",
            "latency=99999999999",
            "status=7",
            "status=999",
            "=",
        ] {
            let why = wrong.parse::<Fault>().unwrap_err();
            assert!(why.contains(&format!("{wrong:?}")), "{why}");
        }
        assert!("nonsense".parse::<Fault>().unwrap_err().contains("handshake-refused"));
    }

    #[test]
    fn each_fault_is_read_as_it_is_written() {
        let valued = [
            Fault::Http10,
            Fault::Latency(Duration::from_millis(250)),
            Fault::Drip(Duration::from_millis(0)),
            Fault::Busy(7),
            Fault::Status(500),
        ];
        for fault in valued.into_iter().chain(PLAIN.map(|(_, fault)| fault)) {
            assert_eq!(fault.to_string().parse(), Ok(fault.clone()), "{fault}");
        }
    }
}
