//! Stand-ins: local publishers, clients and servers that speak for remote ones, under the remote GID.
//!
//! There is one a GID, whatever link its samples come over: the daemon of a host can be restarted,
//! and its successor announces the same endpoints while the last samples of the old link are still
//! being read. They go to the same ring, to which the readers stay attached.
//!
//! That of a client or server reads, too: a client's is given the responses that go to its host, and a
//! server's the requests.

use std::{
    collections::HashMap,
    fmt,
    sync::{
        Arc, Mutex, Weak,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use axon_shm::{Meta, PublishError, ids::Gid};
use axon_transport::{
    Session, SessionError,
    graph::Endpoint,
    internal::session::{RemoteWriter, Written},
};

use super::{
    account::{Account, Charge},
    keyring::lock,
    protection::sample,
    queue::Sample,
};

type Known = Arc<Mutex<HashMap<Gid, Weak<StandIn>>>>;

/// All stand-ins of the gateway.
#[derive(Clone, Default)]
pub(super) struct StandIns(Known);

/// Something remote that writes, as those see it that read here.
pub(super) struct StandIn {
    /// Taken only by `drop`.
    remote_writer: Option<RemoteWriter>,
    /// Held by the stream that feeds it: the stream of a successor waits until its predecessor's
    /// is read to the end, so samples stay in order.
    pub(super) feeding: Arc<tokio::sync::Mutex<()>>,
    /// Sequence number of the newest sample written; 0 before the first.
    last: AtomicU64,
    gid: Gid,
    known: Known,
    _place: Charge,
}

impl StandIns {
    /// The stand-in for `remote`: the one that there is, or a new one; `None` when `account` has as
    /// many as it may.
    ///
    /// # Errors
    /// It cannot be made, or another one under this GID still has readers to be drained.
    pub(super) fn get(
        &self,
        session: &Session,
        remote: &Endpoint,
        account: &Account,
    ) -> Result<Option<Arc<StandIn>>, SessionError> {
        loop {
            let mut known = lock(&self.0);
            match known.get(&remote.gid).map(Weak::upgrade) {
                Some(Some(stand_in)) => {
                    let same = stand_in.endpoint() == remote;
                    // Released first: dropping the last of them takes the lock.
                    drop(known);
                    if same {
                        return Ok(Some(stand_in));
                    }
                    return Err(SessionError::InUse(remote.gid));
                }
                // Being dropped by another thread, which wants this lock.
                Some(None) => {
                    drop(known);
                    std::thread::sleep(Duration::from_micros(100));
                }
                None => {
                    let Some(place) = account.stand_ins.charge(1) else { return Ok(None) };
                    let stand_in = Arc::new(StandIn {
                        remote_writer: Some(RemoteWriter::stand_in(session, remote.clone())?),
                        feeding: Arc::default(),
                        last: AtomicU64::new(0),
                        gid: remote.gid,
                        known: Arc::clone(&self.0),
                        _place: place,
                    });
                    known.insert(remote.gid, Arc::downgrade(&stand_in));
                    return Ok(Some(stand_in));
                }
            }
        }
    }
}

impl StandIn {
    /// Whom it stands for.
    pub(super) fn gid(&self) -> Gid {
        self.gid
    }

    fn endpoint(&self) -> &Endpoint {
        self.remote_writer().endpoint()
    }

    /// Those here whom it reaches and who, where it is of a service, reach it.
    pub(super) fn partners(&self) -> Vec<Gid> {
        self.remote_writer().partners()
    }

    /// Writes a sample, a request, or a response to `client`, without waiting for room.
    ///
    /// # Errors
    /// [`PublishError::Blocked`] when there is none; the others say what does not fit.
    pub(super) fn try_write(
        &self,
        client: &Gid,
        meta: Meta,
        payload: &[u8],
    ) -> Result<Written, PublishError> {
        let written = self.remote_writer().try_write(client, meta, payload)?;
        // Relaxed: only where a resumed route begins; sessions drop what they have seen.
        self.last.store(meta.sequence, Ordering::Relaxed);
        Ok(written)
    }

    /// Its host says that it is alive.
    pub(super) fn assert_alive(&self) {
        self.remote_writer().assert_alive();
    }

    /// The clients of whose calls there is something to be taken here: requests to a server, or a client's
    /// responses.
    pub(super) fn with_calls(&self) -> Vec<Gid> {
        match self.remote_writer() {
            RemoteWriter::Publisher(_) => Vec::new(),
            RemoteWriter::Client(client) => {
                client.has_response().then_some(self.gid).into_iter().collect()
            }
            RemoteWriter::Server(server) => server.with_requests(),
        }
    }

    /// Whether calls of this client are taken here.
    pub(super) fn reads(&self, client: &Gid) -> bool {
        match self.remote_writer() {
            RemoteWriter::Publisher(_) => false,
            RemoteWriter::Client(_) => *client == self.gid,
            RemoteWriter::Server(server) => server.reads(client),
        }
    }

    /// What goes to its host: the next request of this client, or response to it.
    pub(super) fn take_of(&self, client: &Gid) -> Option<Sample> {
        let (info, payload) = match self.remote_writer() {
            RemoteWriter::Publisher(_) => return None,
            RemoteWriter::Client(own) => {
                let mut payload = Vec::new();
                let info = (*client == self.gid).then(|| own.take_response(&mut payload))??;
                (info, payload)
            }
            RemoteWriter::Server(server) => server.take_request_of(client)?,
        };
        Some(Sample { client: Some(*client), ..sample(info, payload) })
    }

    /// Sequence number of the newest sample of a publisher that was written.
    pub(super) fn last_sequence(&self) -> Option<u64> {
        let publisher = matches!(self.remote_writer(), RemoteWriter::Publisher(_));
        Some(self.last.load(Ordering::Relaxed)).filter(|n| publisher && *n > 0)
    }

    fn remote_writer(&self) -> &RemoteWriter {
        // Only `drop` takes it, and nobody looks at what is being dropped.
        self.remote_writer.as_ref().expect("a stand-in has its writer until it is dropped")
    }
}

impl fmt::Debug for StandIn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("StandIn").field(&self.gid).finish()
    }
}

impl Drop for StandIn {
    fn drop(&mut self) {
        // Under the lock: the GID is free for another stand-in once this one is gone.
        let mut known = lock(&self.known);
        drop(self.remote_writer.take());
        known.remove(&self.gid);
    }
}
