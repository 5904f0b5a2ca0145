//! The sockets: TLS for [`http`](super::http) and [`api`](super::api).

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::{Instant, sleep_until, timeout};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

use super::api;
use super::fault::Fault;
use super::handshake::{self, Acceptors, linger, refuse, until_gone};
use super::http::{self, Answer, NoRequest};
use super::network::{KmeState, NetworkShared};
use crate::subject;

/// Most open connections of one KME.
const MAX_CONNECTIONS: usize = 1024;
/// Time for a handshake while other connections wait for a place.
const HANDSHAKE_TIMEOUT_WHEN_FULL: Duration = Duration::from_secs(1);
/// Time for a complete request to arrive, and for its answer to be read.
const IDLE_TIME: Duration = Duration::from_secs(60);
/// Bytes of further requests that are read before an answer has been sent.
const MAX_AHEAD: usize = 64 << 10;

/// Serves until it is aborted, which also ends its connections.
pub(super) async fn serve(
    listener: TcpListener,
    acceptors: Acceptors,
    shared: Arc<NetworkShared>,
    kme: Arc<KmeState>,
) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let mut connections = JoinSet::new();
    let mut strangers = Strangers::default();
    loop {
        while connections.try_join_next().is_some() {}
        let Ok((stream, _)) = listener.accept().await else {
            // Most likely the limit on open files is reached.
            strangers.turn_away_old();
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        let fault = kme.faults().for_connection();
        if fault == Some(Fault::HandshakeDropped) {
            continue;
        }
        let Some(place) = strangers.make_room(&places).await else { return };
        let known = Arc::new(AtomicBool::new(false));
        let task = {
            let acceptor = acceptors.of(fault.as_ref()).clone();
            let (shared, kme, known) = (Arc::clone(&shared), Arc::clone(&kme), Arc::clone(&known));
            connections.spawn(async move {
                let _place = place;
                // A client that breaks off affects only itself.
                let _ = match fault {
                    Some(Fault::HandshakeRefused) => refuse(stream).await,
                    _ => connection(stream, &acceptor, &known, &shared, &kme).await,
                };
            })
        };
        strangers.add(task, known);
    }
}

/// Connections that are not authenticated, oldest first. If all places are taken, one of them is closed after
/// [`HANDSHAKE_TIMEOUT_WHEN_FULL`], so that a peer without a certificate does not block others for long.
#[derive(Default)]
struct Strangers(VecDeque<Stranger>);

struct Stranger {
    since: Instant,
    task: AbortHandle,
    known: Arc<AtomicBool>,
}

impl Stranger {
    fn is_one(&self) -> bool {
        !self.known.load(Ordering::Relaxed) && !self.task.is_finished()
    }
}

impl Strangers {
    fn add(&mut self, task: AbortHandle, known: Arc<AtomicBool>) {
        if self.0.len() >= 2 * MAX_CONNECTIONS {
            self.0.retain(Stranger::is_one);
        }
        self.0.push_back(Stranger { since: Instant::now(), task, known });
    }

    fn oldest(&mut self) -> Option<&Stranger> {
        while self.0.front().is_some_and(|first| !first.is_one()) {
            self.0.pop_front();
        }
        self.0.front()
    }

    fn turn_away_old(&mut self) {
        while let Some(oldest) =
            self.oldest().filter(|oldest| oldest.since.elapsed() >= HANDSHAKE_TIMEOUT_WHEN_FULL)
        {
            oldest.task.abort();
            self.0.pop_front();
        }
    }

    /// Waits for a place for one more connection.
    async fn make_room(&mut self, places: &Arc<Semaphore>) -> Option<OwnedSemaphorePermit> {
        if let Ok(place) = Arc::clone(places).try_acquire_owned() {
            return Some(place);
        }
        let place = Arc::clone(places).acquire_owned();
        tokio::pin!(place);
        if let Some(oldest) = self.oldest() {
            tokio::select! {
                biased;
                place = &mut place => return place.ok(),
                () = sleep_until(oldest.since + HANDSHAKE_TIMEOUT_WHEN_FULL) => oldest.task.abort(),
            }
            // The connection has ended, even if its task has not ended yet.
            self.0.pop_front();
        }
        place.await.ok()
    }
}

async fn connection(
    stream: TcpStream,
    acceptor: &TlsAcceptor,
    known: &AtomicBool,
    shared: &NetworkShared,
    kme: &KmeState,
) -> std::io::Result<()> {
    stream.set_nodelay(true)?;
    let accepted = acceptor.accept(stream).into_fallible();
    let Ok(accepted) = timeout(handshake::TIME, accepted).await else { return Ok(()) };
    let mut stream = match accepted {
        Ok(stream) => stream,
        Err((_, stream)) => return linger(stream).await,
    };
    known.store(true, Ordering::Relaxed);
    let caller = stream
        .get_ref()
        .1
        .peer_certificates()
        .and_then(|chain| subject::common_name(chain.first()?));
    let mut buffer = Vec::new();
    loop {
        let read = http::read(&mut stream, &mut buffer, shared.strict);
        let request = match timeout(IDLE_TIME, read).await {
            Ok(Ok(request)) => request,
            Ok(Err(NoRequest::Refused(status, why))) => {
                let answer = Answer { close: true, ..api::error(status, why, Vec::new()) };
                let write = http::write(&mut stream, &answer, None);
                timeout(IDLE_TIME, write).await.unwrap_or(Ok(false))?;
                return linger(stream).await;
            }
            Ok(Err(NoRequest::Closed)) | Err(_) => return stream.shutdown().await,
        };
        let met = kme.faults().for_request(api::method(&request));
        let fault = met.fault;
        let answer = api::answer(shared, kme, caller.as_deref(), &request, fault.as_ref());
        if !met.delay.is_zero() && !delay(&mut stream, &mut buffer, met.delay).await {
            return Ok(());
        }
        match fault {
            Some(Fault::Silence) => return until_gone(&mut stream).await,
            Some(Fault::ResetAfterRequest) => {
                let _ = stream.get_ref().0.set_zero_linger();
                return Ok(());
            }
            _ => {}
        }
        let write = http::write(&mut stream, &answer, fault.as_ref());
        let stays = match fault {
            // A client that reads nothing must not stay for ever.
            None => timeout(IDLE_TIME, write).await.unwrap_or(Ok(false))?,
            Some(_) => write.await?,
        };
        if !stays {
            if fault == Some(Fault::LyingLength) {
                return until_gone(&mut stream).await;
            }
            return stream.shutdown().await;
        }
    }
}

/// Waits before an answer. Returns whether the client is still there: a client that is gone would occupy a place until
/// the time is over.
async fn delay(stream: &mut TlsStream<TcpStream>, buffer: &mut Vec<u8>, time: Duration) -> bool {
    let until = Instant::now() + time;
    while buffer.len() < MAX_AHEAD {
        tokio::select! {
            () = sleep_until(until) => return true,
            read = stream.read_buf(buffer) => {
                if !matches!(read, Ok(1..)) {
                    return false;
                }
            }
        }
    }
    sleep_until(until).await;
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The connections never end, and the first is authenticated. The simulated clock advances when all tasks wait.
    #[tokio::test(start_paused = true)]
    async fn unauthenticated_connections_give_way_in_turn_and_authenticated_connections_stay() {
        const PLACES: usize = 4;
        let places = Arc::new(Semaphore::new(PLACES));
        let (mut strangers, mut tasks) = (Strangers::default(), JoinSet::new());
        let mut handles = Vec::new();
        let began = Instant::now();
        for number in 0..20 {
            let room =
                timeout(HANDSHAKE_TIMEOUT_WHEN_FULL * 60, strangers.make_room(&places)).await;
            let place = room.expect("a stranger gives way").unwrap();
            let task = tasks.spawn(async move {
                let _place = place;
                std::future::pending::<()>().await;
            });
            handles.push(task.clone());
            strangers.add(task, Arc::new(AtomicBool::new(number == 0)));
        }
        // There are sixteen too many, and three are closed at a time.
        assert!(
            began.elapsed() >= HANDSHAKE_TIMEOUT_WHEN_FULL * 6
                && began.elapsed() < HANDSHAKE_TIMEOUT_WHEN_FULL * 7
        );
        let still: Vec<bool> = handles.iter().map(|task| !task.is_finished()).collect();
        let newest = handles.len() + 1 - PLACES;
        let expected: Vec<bool> = (0..handles.len()).map(|at| at == 0 || at >= newest).collect();
        assert_eq!(still, expected);
    }
}
