//! Runs the key state machines' [`KmeRequest`]s at the KME, with limits, and answers every one of them. No other module
//! talks to the KME.
//!
//! Calls for links (bootstrap, handshakes, proofs) and calls for messages wait in two queues with separate limits,
//! so that the message supply cannot block the start of a link.

mod calls;
mod outage;
mod statistics;

use std::{
    path::Path,
    sync::Arc,
    time::{Duration, Instant},
};

use crate::files::FileRules;
use axon_transport::{config::QkdConfig, internal::secrets};
use etsi_qkd014::{Client, Quirks, RetryPolicy};
use tokio::{
    sync::{Semaphore, mpsc},
    task::JoinSet,
};
use zeroize::Zeroizing;

use super::{
    request::{Answer, FailureKind, Fetched, KeyPurpose, KmeRequest, RequestFailure, Stock},
    used::UsedKeys,
};

pub use statistics::{CallStatistics, Statistics};

use calls::KmeCaller;

/// Maximum number of requests that wait, for links and for messages separately.
const QUEUE: usize = 256;
/// Calls in flight for links: 16 for handshakes that come in, 8 for dials, and room for proofs.
const LINK_CALLS: usize = 32;
/// Calls in flight for messages.
const MESSAGE_CALLS: usize = 16;

/// The origin of a request, which gets the answer. The caller chooses the numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum RequestOrigin {
    /// The [`BootstrapDialler`](super::BootstrapDialler).
    Dialler,
    /// The [`Acceptor`](super::Acceptor).
    Acceptor,
    /// A [`ClientProof`](super::ClientProof).
    Proof(u64),
    /// A [`ProofResponder`](super::ProofResponder).
    Responder(u64),
    /// A [`KeySender`](super::KeySender).
    Sender(u64),
    /// A [`KeyReceiver`](super::KeyReceiver).
    Receiver(u64),
}

/// An answer, with the origin of its request.
#[derive(Debug)]
pub struct KmeAnswer {
    /// The origin of the request.
    pub origin: RequestOrigin,
    /// The answer.
    pub answer: Answer,
}

/// The reason why the KME client cannot be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KmeError {
    /// A file cannot be read.
    #[error("{variable}={path}: {reason}")]
    File {
        /// The variable that names the file.
        variable: &'static str,
        /// The path.
        path: String,
        /// The reason.
        reason: String,
    },
    /// A setting is unusable.
    #[error("{variable}: {reason}")]
    Setting {
        /// The variable.
        variable: &'static str,
        /// The defect, and the accepted values.
        reason: String,
    },
}

/// Takes requests. Clones share the KME; calls end when the last is dropped.
#[derive(Clone)]
pub struct Kme(Arc<KmeShared>);

struct KmeShared {
    caller: Arc<KmeCaller>,
    links: mpsc::Sender<Job>,
    messages: mpsc::Sender<Job>,
}

/// The receiver of the answers.
pub struct Events(mpsc::Receiver<KmeAnswer>);

struct Job {
    origin: RequestOrigin,
    request: KmeRequest,
    since: Instant,
}

impl Kme {
    /// Checks that the settings make a client: URL, certificates, key and quirks. Opens no connection.
    ///
    /// # Errors
    /// The wrong variable, and its defect.
    pub fn check(config: &QkdConfig) -> Result<(), KmeError> {
        client(config).map(drop)
    }

    /// Starts taking requests, on the current tokio runtime. Keys that are in `used` already are
    /// not given out.
    ///
    /// # Errors
    /// As [`check`](Self::check).
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn start(config: &QkdConfig, used: UsedKeys) -> Result<(Self, Events), KmeError> {
        if let Err(error) = secrets::prepare() {
            tracing::warn!(%error, "there is no memory for keys yet");
        }
        let caller = Arc::new(KmeCaller::new(client(config)?, config, used));
        let (events, receiver) = mpsc::channel(QUEUE);
        let serve = |limit: usize| {
            let (sender, jobs) = mpsc::channel(QUEUE);
            tokio::spawn(serve(Arc::clone(&caller), limit, jobs, events.clone()));
            sender
        };
        let (links, messages) = (serve(LINK_CALLS), serve(MESSAGE_CALLS));
        Ok((Self(Arc::new(KmeShared { caller, links, messages })), Events(receiver)))
    }

    /// Queues a request; its answer comes out of [`Events`]. Never blocks.
    ///
    /// # Errors
    /// The queue is full: the answer, to be given to the machine as if it had come out of there.
    pub fn submit(&self, origin: RequestOrigin, request: KmeRequest) -> Result<(), Box<KmeAnswer>> {
        let queue = match &request {
            KmeRequest::Enc { purpose: KeyPurpose::Messages, .. }
            | KmeRequest::Dec { purpose: KeyPurpose::Messages, .. }
            | KmeRequest::Status { .. } => &self.0.messages,
            _ => &self.0.links,
        };
        queue.try_send(Job { origin, request, since: Instant::now() }).map_err(|e| {
            let Job { origin, request, .. } = e.into_inner();
            let text = format!("{QUEUE} calls wait for the KME already");
            let outcome = Err(RequestFailure::new(FailureKind::Busy, text));
            Box::new(KmeAnswer {
                origin,
                answer: Answer { request, took: Duration::ZERO, outcome },
            })
        })
    }

    /// Asks the KME for its status with `slave`: whether it can be reached and accepts this SAE.
    ///
    /// # Errors
    /// Why not.
    pub async fn probe(&self, slave: &str) -> Result<Stock, RequestFailure> {
        let request = KmeRequest::Status { slave: slave.to_owned() };
        match self.0.caller.run(&request).await? {
            Fetched::Stock(stock) => Ok(stock),
            Fetched::Keys(_) => {
                Err(RequestFailure::new(FailureKind::Invalid, "status answered with keys"))
            }
        }
    }

    /// Returns the counters of requests and keys since the start.
    pub fn statistics(&self) -> Statistics {
        self.0.caller.statistics()
    }
}

impl Events {
    /// Waits for the next answer; `None` when the last [`Kme`] is dropped and all requests are answered. Cancel safe.
    pub async fn recv(&mut self) -> Option<KmeAnswer> {
        self.0.recv().await
    }

    /// Polls for the next answer, as [`recv`](Self::recv) awaits it.
    pub fn poll_recv(
        &mut self,
        cx: &mut std::task::Context<'_>,
    ) -> std::task::Poll<Option<KmeAnswer>> {
        self.0.poll_recv(cx)
    }

    /// Returns the next answer, if there is one now.
    pub fn try_recv(&mut self) -> Option<KmeAnswer> {
        self.0.try_recv().ok()
    }
}

/// Runs the jobs of one queue, `limit` at a time, and answers each.
async fn serve(
    caller: Arc<KmeCaller>,
    limit: usize,
    mut jobs: mpsc::Receiver<Job>,
    events: mpsc::Sender<KmeAnswer>,
) {
    let free = Arc::new(Semaphore::new(limit));
    let mut running = JoinSet::new();
    loop {
        let permit = tokio::select! {
            permit = Arc::clone(&free).acquire_owned() => permit,
            // The receiver is gone: dropping the calls in flight aborts them.
            () = events.closed() => return,
        };
        let (Ok(permit), Some(job)) = (permit, next(&mut jobs, &mut running, &events).await) else {
            break;
        };
        let (caller, events) = (Arc::clone(&caller), events.clone());
        running.spawn(async move {
            let outcome = caller.run(&job.request).await;
            // The receiver of the last answer may start the next client at once, on the same file.
            drop(caller);
            drop(permit);
            let took = job.since.elapsed();
            let answer = Answer { request: job.request, took, outcome };
            // A failed send means that the receiver is gone.
            let _ = events.send(KmeAnswer { origin: job.origin, answer }).await;
        });
    }
    drop(caller);
    while running.join_next().await.is_some() {}
}

/// Waits for the next job; meanwhile removes finished calls.
async fn next(
    jobs: &mut mpsc::Receiver<Job>,
    running: &mut JoinSet<()>,
    events: &mpsc::Sender<KmeAnswer>,
) -> Option<Job> {
    loop {
        tokio::select! {
            job = jobs.recv() => return job,
            Some(_) = running.join_next() => {}
            () = events.closed() => return None,
        }
    }
}

fn client(config: &QkdConfig) -> Result<Client, KmeError> {
    let of_client = config.kme_quirks.iter().filter(|quirk| *quirk != QkdConfig::NO_NAME_CHECK);
    let quirks = of_client.cloned().collect::<Vec<_>>().join(",").parse::<Quirks>();
    // The key is in a block of exactly its size, so that no shrinking leaves a copy; the buffer that was read is
    // erased.
    let sae_key =
        Box::<[u8]>::from(read("AXON_SAE_KEY", &config.sae_key, FileRules::KEY)?.as_slice());
    let mut builder = Client::builder()
        .kme_url(&config.kme_url)
        .ca(read("AXON_KME_CA", &config.kme_ca, FileRules::CERTIFICATES)?.as_slice())
        .sae_cert(read("AXON_SAE_CERT", &config.sae_cert, FileRules::CERTIFICATES)?.as_slice())
        .sae_key(sae_key)
        .connect_timeout(config.kme_connect_timeout)
        .timeout(config.kme_answer_timeout)
        // The state machines repeat calls that may be repeated, at the right time.
        .retry(RetryPolicy::none())
        .quirks(quirks.map_err(|error| setting(config, error))?);
    if let Some(id) = &config.kme_id {
        builder = builder.kme_id(id);
    }
    if !config.checks_name() {
        builder = builder.kme_id_replaces_name_check();
    }
    builder.build().map_err(|error| setting(config, error))
}

fn read(
    variable: &'static str,
    path: &Path,
    demands: FileRules,
) -> Result<Zeroizing<Vec<u8>>, KmeError> {
    let failure = |reason| KmeError::File { variable, path: path.display().to_string(), reason };
    demands.read(path).map_err(failure)
}

/// Returns the error that names the variable behind the client's setting.
fn setting(config: &QkdConfig, e: etsi_qkd014::Error) -> KmeError {
    let (setting, reason) = match e {
        etsi_qkd014::Error::Config { setting, reason } => (setting, reason),
        other => ("", other.to_string()),
    };
    let variable = match setting {
        "kme_url" => "AXON_KME_URL",
        "ca" | "sae_cert" | "sae_key" => {
            let (variable, path) = match setting {
                "ca" => ("AXON_KME_CA", &config.kme_ca),
                "sae_cert" => ("AXON_SAE_CERT", &config.sae_cert),
                _ => ("AXON_SAE_KEY", &config.sae_key),
            };
            return KmeError::File { variable, path: path.display().to_string(), reason };
        }
        "kme_id" => "AXON_KME_ID",
        "kme_id_replaces_name_check" => "AXON_KME_QUIRKS",
        "quirks" => "AXON_KME_QUIRKS",
        _ => "KME client",
    };
    KmeError::Setting { variable, reason }
}

#[cfg(test)]
mod tests;
