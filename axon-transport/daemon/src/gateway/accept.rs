//! Answering dials: Retry for every unvalidated address, then the handshake, then
//! [`establish`](super::establish).

use std::{
    net::SocketAddr,
    sync::Arc,
    time::{Duration, Instant},
};

use quinn::{ConnectionError, Endpoint, Incoming};
use tokio::sync::mpsc;

use super::{
    context::Context,
    establish::{Established, establish},
    refusal::Refusal,
    shares::{Handshakes, Said},
};
use crate::{
    keys::{Lookup, Resolver},
    link::{CloseCode, Side},
};

const DECRYPT_ERROR: u8 = 51;
/// Handshakes under way at once, but for those of listed peers; further dials are refused and come again.
pub(crate) const MAX_HANDSHAKES: usize = 64;
/// A dialler that has its Retry is given this long for the rest of the handshake.
pub(crate) const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);

/// What came of an incoming dial.
#[derive(Debug)]
pub(crate) enum Incomer {
    /// It awaits its election.
    Established(Box<Established>),
    /// It was refused.
    Refused {
        /// The address, and the SAE that it claimed.
        peer: String,
        /// By whom and why.
        refusal: Refusal,
    },
}

/// Accepts on `endpoint` until it is closed.
pub(crate) async fn accept(
    context: Arc<Context>,
    endpoint: Endpoint,
    handshakes: Arc<Handshakes>,
    incomers: mpsc::Sender<Incomer>,
) {
    let mut crowded = Said::default();
    while let Some(incoming) = endpoint.accept().await {
        if !incoming.remote_address_validated() {
            // Before any key work. A fresh Incoming may always be answered with a Retry.
            if incoming.may_retry() {
                let _ = incoming.retry();
            } else {
                incoming.refuse();
            }
            continue;
        }
        let source = incoming.remote_address();
        let Some(place) = handshakes.enter(source.ip(), context.is_listed(source.ip())) else {
            incoming.refuse();
            if crowded.is_news(source.ip(), Instant::now()) {
                let text = "hosts at this address have as many handshakes under way as they may";
                let refusal = Refusal::here(CloseCode::NotAllowed, text);
                let peer = super::establish::peer_text(None, source);
                // Where that finds no room, it is not said.
                let _ = incomers.try_send(Incomer::Refused { peer, refusal });
            }
            continue;
        };
        let (context, incomers) = (Arc::clone(&context), incomers.clone());
        tokio::spawn(async move {
            let incomer = answer(&context, incoming).await;
            drop(place);
            if let Some(incomer) = incomer {
                let _ = incomers.send(incomer).await;
            }
        });
    }
}

/// `None` when the dialler is to come again and nothing is to be said of it.
async fn answer(context: &Arc<Context>, incoming: Incoming) -> Option<Incomer> {
    let source = incoming.remote_address();
    let refused = |refusal, resolver: Option<&Resolver>| {
        let claimed = resolver.and_then(Resolver::identity);
        let sae = claimed.as_ref().map(|i| i.client_sae());
        let peer = super::establish::peer_text(sae, source);
        Some(Incomer::Refused { peer, refusal })
    };
    let (server, resolver) = match context.server(source) {
        Ok(server) => server,
        Err(error) => {
            incoming.refuse();
            return refused(Refusal::here(CloseCode::Internal, error), None);
        }
    };
    // A hello that comes in one packet is answered, or refused, right here.
    let connecting = match incoming.accept_with(Arc::new(server)) {
        Ok(connecting) => connecting,
        Err(error) => {
            let refusal = explained(&error, resolver.as_deref(), source)?;
            return refused(refusal, resolver.as_deref());
        }
    };
    let connection = match tokio::time::timeout(HANDSHAKE_TIMEOUT, connecting).await {
        Ok(Ok(connection)) => connection,
        Err(_) => {
            let late = Refusal::network("the dialler did not finish its handshake within 10 s");
            return refused(late, resolver.as_deref());
        }
        Ok(Err(error)) => {
            let refusal = explained(&error, resolver.as_deref(), source)?;
            return refused(refusal, resolver.as_deref());
        }
    };
    match establish(context, connection, Side::Server, context.hello.clone(), None).await {
        Ok(established) => Some(Incomer::Established(Box::new(established))),
        Err(refusal) => refused(refusal, resolver.as_deref()),
    }
}

/// Why a handshake failed, with what the look-up of its key says; `None` where that is how every
/// bootstrap begins: the key is being fetched, and the dialler comes again.
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
