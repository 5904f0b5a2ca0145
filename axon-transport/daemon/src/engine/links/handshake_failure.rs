//! Explains why an incoming handshake failed, and names the key.

use std::net::SocketAddr;

use quinn_proto::ConnectionError;

use crate::{
    engine::{link::target::DECRYPT_ERROR, refusal::Refusal},
    keys::{Lookup, Resolver},
};

/// Returns why a handshake failed, with the result of the key's look-up. Returns `None` for the normal start of a
/// bootstrap: the key is being fetched, and the dialler comes again.
pub(crate) fn explained(
    error: &ConnectionError,
    resolver: Option<&Resolver>,
    source: SocketAddr,
) -> Option<Refusal> {
    let mut refusal = Refusal::of(error);
    let Some(outcome) = resolver.and_then(Resolver::outcome) else { return Some(refusal) };
    match outcome {
        Lookup::Fetching => {
            tracing::debug!(%source, "a PSK is being fetched; the dialler will come again");
            return None;
        }
        Lookup::Found if refusal.alert == Some(DECRYPT_ERROR) => {
            let what = "either the KMEs disagree about it and their operators must compare what \
                        they hold for these two SAEs, or somebody copied its name";
            refusal.reason = format!("{}: {what}", refusal.reason);
        }
        outcome => refusal.reason = format!("{}; PSK look-up: {outcome}", refusal.reason),
    }
    Some(refusal)
}
