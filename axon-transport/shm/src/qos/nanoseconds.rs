//! Periods as they are on every wire and in shared memory: nanoseconds, in 64 bits. A longer period, of over 584
//! years, is encoded as the longest one.

use std::time::Duration;

use minicbor::{
    Decoder, Encoder,
    data::Type,
    decode::Error as DecodeError,
    encode::{Error as EncodeError, Write},
};
use serde::Serializer;

/// Converts a period to nanoseconds.
pub fn nanoseconds(period: Duration) -> u64 {
    u64::try_from(period.as_nanos()).unwrap_or(u64::MAX)
}

pub(super) fn encode<C, W: Write>(
    period: &Option<Duration>,
    e: &mut Encoder<W>,
    _: &mut C,
) -> Result<(), EncodeError<W::Error>> {
    match period {
        Some(period) => e.u64(nanoseconds(*period))?.ok(),
        None => e.null()?.ok(),
    }
}

pub(super) fn decode<C>(d: &mut Decoder<'_>, _: &mut C) -> Result<Option<Duration>, DecodeError> {
    if d.datatype()? == Type::Null {
        return d.null().map(|()| None);
    }
    d.u64().map(|period| Some(Duration::from_nanos(period)))
}

/// The value of an entry that is left out.
#[expect(clippy::option_option, reason = "what minicbor asks for, of a type that is an option")]
pub(super) const fn nil() -> Option<Option<Duration>> {
    Some(None)
}

#[expect(clippy::ref_option, reason = "what minicbor asks for")]
pub(super) const fn is_nil(period: &Option<Duration>) -> bool {
    period.is_none()
}

#[expect(clippy::ref_option, reason = "what serde asks for")]
pub(super) fn serialize<S: Serializer>(
    period: &Option<Duration>,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    match period {
        Some(period) => serializer.serialize_some(&nanoseconds(*period)),
        None => serializer.serialize_none(),
    }
}
