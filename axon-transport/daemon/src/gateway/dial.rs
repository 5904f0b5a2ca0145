//! Dialling a peer: every candidate address in turn, in qkd with one bootstrap key redialled until
//! the peer's KME has it (`docs/formats.md`, section 2).

use std::{net::SocketAddr, sync::Arc, time::Duration};

use axon_shm::ids::DaemonId;
use quinn::{Connection, ConnectionError};

use super::{
    context::Context,
    endpoint::Endpoints,
    establish::{Established, establish},
    keyring::warn_disagreement,
    refusal::Refusal,
};
use crate::{
    discovery::AddressConfidence,
    keys::{Completion, Dial},
    link::{CloseCode, Hello, Side},
};

/// One address is given this long to complete the handshake.
pub(crate) const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);
/// A dial, with all its redials, is given up after this, in qkd with two KME calls; discovery backs
/// off and dials again.
const DIAL_TIMEOUT: Duration = Duration::from_secs(20);
/// Alerts of a server that does not have the key (yet), or has another.
pub(crate) const UNKNOWN_PSK_IDENTITY: u8 = 115;
pub(crate) const DECRYPT_ERROR: u8 = 51;

/// Whom to dial.
#[derive(Clone, Debug)]
pub(crate) struct Target {
    /// The daemon expected there, `None` when any will do.
    pub(crate) daemon: Option<DaemonId>,
    /// Its SAE ID, in qkd.
    pub(crate) sae: Option<String>,
    /// Where it may be, best first.
    pub(crate) addresses: Vec<SocketAddr>,
    /// Whether this host lists it as a static peer.
    pub(crate) listed: bool,
    /// Why it may be there, where discovery says so.
    pub(crate) standing: Option<AddressConfidence>,
    /// The link that the new connection succeeds.
    pub(crate) replaces: Option<[u8; 16]>,
}

impl Target {
    /// For log and status.
    pub(crate) fn text(&self) -> String {
        let addresses: Vec<_> = self.addresses.iter().map(ToString::to_string).collect();
        match &self.sae {
            Some(sae) => format!("{sae} at {}", addresses.join(", ")),
            None => addresses.join(", "),
        }
    }

    /// This side's HELLO to it.
    pub(crate) fn hello(&self, ours: &Hello) -> Hello {
        Hello {
            expects: self.daemon,
            static_peer: self.listed,
            replaces: self.replaces,
            ..ours.clone()
        }
    }
}

/// How long a whole dial may take; in qkd a KME call may take as long as `kme_answer`.
pub(crate) fn dial_limit(kme_answer: Option<Duration>) -> Duration {
    DIAL_TIMEOUT + kme_answer.map(|answer| 2 * answer).unwrap_or_default()
}

/// Dials until a link awaits its election, or says why none does.
pub(super) async fn dial(
    context: &Arc<Context>,
    endpoints: &Endpoints,
    target: &Target,
) -> Result<Established, Refusal> {
    let hello = target.hello(&context.hello);
    let connect = async {
        match &context.keyring {
            None => {
                let client = context.classic_client().map_err(internal)?;
                handshake(endpoints, target, &client).await
            }
            Some(_) => qkd(context, endpoints, target).await,
        }
    };
    // Not around `establish`, which has limits of its own and cleans up after itself.
    let limit = dial_limit(context.keyring.as_ref().map(|k| k.config.kme_answer_timeout));
    let late = |_| Refusal::network(format!("no answer within {limit:?}"));
    let connection = tokio::time::timeout(limit, connect).await.map_err(late)??;
    establish(context, connection, Side::Client, hello, target.sae.as_deref()).await
}

fn internal(error: impl std::fmt::Display) -> Refusal {
    Refusal::here(CloseCode::Internal, error)
}

/// Why no address answered.
pub(crate) enum Unreached {
    /// A peer, or this side, ended the handshake.
    Handshake(ConnectionError),
    /// Nothing came back.
    Silence(String),
}

impl Unreached {
    pub(crate) fn refusal(&self) -> Refusal {
        match self {
            Self::Handshake(error) => Refusal::of(error),
            Self::Silence(reason) => Refusal::network(reason),
        }
    }
}

/// One handshake with the first address that answers.
pub(super) async fn handshake(
    endpoints: &Endpoints,
    target: &Target,
    client: &quinn::ClientConfig,
) -> Result<Connection, Refusal> {
    reach(endpoints, target, client).await.map_err(|e| e.refusal())
}

/// The first address at which the handshake completes.
async fn reach(
    endpoints: &Endpoints,
    target: &Target,
    client: &quinn::ClientConfig,
) -> Result<Connection, Unreached> {
    let mut last = Unreached::Silence("no address to dial".into());
    for address in &target.addresses {
        let Some(endpoint) = endpoints.towards(*address) else {
            last = Unreached::Silence(format!(
                "{address} cannot be reached from the addresses in AXON_BIND_ADDRS"
            ));
            continue;
        };
        // Neither sent nor checked: a peer is known by its key, its SAE, or its certificate and
        // what it calls itself in HELLO.
        let connecting = match endpoint.connect_with(client.clone(), *address, "axon") {
            Ok(connecting) => connecting,
            Err(error) => {
                last = Unreached::Silence(format!("{address}: {error}"));
                continue;
            }
        };
        match tokio::time::timeout(HANDSHAKE_TIMEOUT, connecting).await {
            Ok(Ok(connection)) => return Ok(connection),
            Ok(Err(ConnectionError::TimedOut)) | Err(_) => {
                last = Unreached::Silence(format!("{address} does not answer"));
            }
            // Whoever answers at one address answers at all of them.
            Ok(Err(error)) => return Err(Unreached::Handshake(error)),
        }
    }
    Err(last)
}

/// A connection under a KME key, dialled again with the same key until the server has it.
async fn qkd(
    context: &Arc<Context>,
    endpoints: &Endpoints,
    target: &Target,
) -> Result<Connection, Refusal> {
    let Some(keyring) = &context.keyring else { return Err(internal("no keys in classic")) };
    let Some(sae) = target.sae.as_deref() else {
        return Err(Refusal::here(CloseCode::Mode, "the peer states no SAE ID: it is not in qkd"));
    };
    let mut waited_for = String::new();
    loop {
        match keyring.with_dialler(|now, dialler| dialler.dial(now, sae)) {
            Dial::Refused(reason) => return Err(Refusal::here(CloseCode::NotAllowed, reason)),
            Dial::Wait { until, why } => {
                // Given up until the next dial: the machine is in its back-off.
                if until.is_some_and(|u| u > keyring.clock.now() + Duration::from_secs(2)) {
                    return Err(Refusal::here(CloseCode::KeySupply, why));
                }
                if waited_for != why {
                    tracing::debug!(peer = sae, why, "dial waits");
                    waited_for = why;
                }
                keyring.dialler_ready(until).await;
            }
            Dial::Attempt(attempt) => {
                let client = context.qkd_client(&attempt).map_err(internal)?;
                let key_id = &attempt.key_id;
                let error = match reach(endpoints, target, &client).await {
                    Ok(connection) => {
                        let spent =
                            |now, d: &mut crate::keys::Dialler| d.succeeded(now, sae, key_id);
                        if keyring.with_dialler(spent) == Completion::Reused {
                            let text = "this PSK has completed a handshake before";
                            super::establish::close(&connection, CloseCode::KeyReused, text);
                            return Err(Refusal::here(CloseCode::KeyReused, text));
                        }
                        return Ok(connection);
                    }
                    Err(error) => error,
                };
                let refusal = error.refusal();
                match refusal.alert {
                    Some(UNKNOWN_PSK_IDENTITY) => {
                        keyring.with_dialler(|now, d| d.refused(now, sae, key_id));
                        tracing::debug!(peer = sae, %refusal, "the peer does not have the key yet");
                    }
                    Some(DECRYPT_ERROR) => {
                        tracing::debug!(peer = sae, %refusal, "the peer has another key");
                        if keyring.with_dialler(|now, d| d.mismatched(now, sae, key_id)) {
                            let what = format_args!("key_ID {key_id}");
                            warn_disagreement(&keyring.config, sae, &what);
                        }
                    }
                    _ => {
                        keyring.with_dialler(|now, d| d.silent(now, sae, key_id));
                        return Err(refusal);
                    }
                }
            }
        }
    }
}
