//! The loop: passes that take in the ready inputs, and the wait between passes.

use std::{
    future::poll_fn,
    io,
    pin::pin,
    rc::Rc,
    sync::Arc,
    task::Poll,
    time::{Duration, Instant},
};

use axon_shm::internal::return_free_memory;
use axon_transport::{Session, config::LinkPoll};
use tokio::{
    sync::mpsc,
    task::{spawn_blocking, yield_now},
    time::sleep,
};

use super::{
    compressor::CompressorThread,
    control_outbox::ControlOutbox,
    inputs::{Inputs, ReactorInput, TaskResult},
    key_reports::KeyReports,
    poll_rule::{PollDecision, PollRule},
    rings::ShmRings,
    session::{Notices, local_graph},
    shutdown::ShutdownDrain,
    sockets::{ReceivedDatagram, Sockets},
    timer::Timer,
};
use crate::{
    bridge::{ToControl, ToGateway},
    discovery::{interfaces, is_discovery},
    engine::{Effect, Engine},
    error::GatewayError,
    identity::Identity,
    keys::{Events, Kme, KmeAnswer, UsedKeys},
};

/// Maximum number of system calls that send packets in one pass, before the loop takes in new inputs.
const MAX_SENDS: usize = 64;
/// Between two looks at the files of the identity: a change is in force within a second.
const IDENTITY_CHECK_INTERVAL: Duration = Duration::from_millis(250);
/// Maximum time for the last packets of closed connections.
const GOODBYE: Duration = Duration::from_millis(500);
/// Sleep of the thread in a flood of discovery datagrams; the next pass takes in the datagrams that came meanwhile.
const REST: Duration = Duration::from_millis(2);
/// Freed memory is given back to the system after this time.
const RETURN: Duration = Duration::from_secs(1);

/// The parts of a reactor.
pub(super) struct ReactorParts {
    pub(super) engine: Engine,
    /// Whether the reactor looks for inputs before it sleeps.
    pub(super) poll: LinkPoll,
    /// The instant of the engine's time zero.
    pub(super) epoch: Instant,
    pub(super) sockets: Sockets,
    pub(super) rings: Rc<ShmRings>,
    pub(super) session: Session,
    pub(super) notices: Arc<Notices>,
    pub(super) control: mpsc::Sender<ToControl>,
    pub(super) orders: mpsc::Receiver<ToGateway>,
    /// In qkd.
    pub(super) kme: Option<(Kme, UsedKeys)>,
    pub(super) key_events: Option<Events>,
    /// In classic.
    pub(super) identity: Option<Arc<Identity>>,
}

/// The reactor of one daemon.
pub(super) struct Reactor {
    engine: Engine,
    epoch: Instant,
    sockets: Sockets,
    rings: Rc<ShmRings>,
    session: Session,
    notices: Arc<Notices>,
    told: ControlOutbox,
    inputs: Inputs,
    kme: Option<(Kme, UsedKeys)>,
    /// Answers that the KME client gave at once.
    answers: Vec<KmeAnswer>,
    report_done: mpsc::UnboundedSender<TaskResult>,
    compressor: CompressorThread,
    buffer: Vec<u8>,
    /// The last datagrams were a flood of discovery's, and nothing else.
    is_flooded: bool,
    /// Packets may be left that the last pass did not send.
    has_packets: bool,
    finishing: Option<ShutdownDrain>,
    shutdown: bool,
    key_reports: KeyReports,
    looks: PollRule,
    timer: Timer,
}

impl Reactor {
    /// Creates a reactor, which does not run yet. Needs a tokio runtime.
    ///
    /// # Errors
    /// The doorbell cannot be watched.
    pub(super) fn new(parts: ReactorParts) -> io::Result<Self> {
        let (report_done, done) = mpsc::unbounded_channel();
        if let Some(identity) = parts.identity.filter(|identity| identity.has_files()) {
            tokio::spawn(watch_files(identity, report_done.clone()));
        }
        let processors = std::thread::available_parallelism().map_or(1, usize::from);
        let inputs = Inputs::new(parts.orders, parts.key_events, done, &parts.rings)?;
        Ok(Self {
            engine: parts.engine,
            epoch: parts.epoch,
            sockets: parts.sockets,
            rings: parts.rings,
            session: parts.session,
            notices: parts.notices,
            told: ControlOutbox::new(parts.control),
            inputs,
            kme: parts.kme,
            answers: Vec::new(),
            compressor: CompressorThread::new(report_done.clone()),
            report_done,
            buffer: Vec::new(),
            is_flooded: false,
            has_packets: false,
            finishing: None,
            shutdown: false,
            key_reports: KeyReports::default(),
            looks: PollRule::new(parts.poll, processors),
            timer: Timer::new(),
        })
    }

    fn now(&self) -> Duration {
        self.epoch.elapsed()
    }

    /// Runs until the control plane ends it, or is gone.
    ///
    /// # Errors
    /// The control plane dropped the gateway's session.
    pub(super) async fn run(mut self) -> Result<(), GatewayError> {
        let local = local_graph(&self.session);
        self.engine.handle_local_graph(self.now(), local);
        while !self.shutdown && !self.notices.is_lost() {
            let busy = self.pass();
            if self.shutdown {
                break;
            }
            self.wait(busy).await;
        }
        self.end().await;
        if self.shutdown { Ok(()) } else { Err(GatewayError::SessionLost) }
    }

    /// Closes all links, and lets their last packets out.
    async fn end(&mut self) {
        let now = self.now();
        self.engine.close(now);
        let until = now + GOODBYE;
        loop {
            self.pass();
            if self.engine.is_idle() || self.now() >= until {
                break;
            }
            self.wait_until(Some(until)).await;
        }
        let _ = tokio::time::timeout(GOODBYE, self.told.flush()).await;
    }

    /// Takes in all ready inputs and handles them. Returns whether there was any.
    fn pass(&mut self) -> bool {
        let now = self.now();
        let mut busy = self.take_in(now);
        if self.engine.poll_timeout(now).is_some_and(|due| due <= now) {
            self.engine.handle_timeout(now);
            busy = true;
        }
        loop {
            self.engine.settle(now);
            self.carry_out(now);
            // Arming it looks at the rings once more: room may have been made before.
            if self.rings.is_armed_too_little() {
                self.rings.arm();
                self.engine.handle_rings(now);
            } else if self.answers.is_empty() {
                break;
            }
            for answer in std::mem::take(&mut self.answers) {
                self.engine.handle_key_event(now, answer);
            }
        }
        busy |= self.transmit(now);
        self.look_whether_finished(now);
        self.report_keys(now);
        busy
    }

    fn take_in(&mut self, now: Duration) -> bool {
        let mut busy = false;
        if !self.told.is_behind() {
            let (engine, mut of_quic) = (&mut self.engine, false);
            let (any, drained) = self.sockets.receive(|datagram| {
                let ReceivedDatagram { socket, from, local, ecn, bytes } = datagram;
                of_quic |= !bytes.first().is_some_and(|first| is_discovery(*first));
                engine.handle_datagram(now, socket, from, local, ecn, bytes);
            });
            self.is_flooded = any && drained && !of_quic && engine.holds_discovery();
            busy |= any && !self.is_flooded;
        }
        for input in self.inputs.take() {
            busy = true;
            match input {
                ReactorInput::Order(order) => self.handle_order(now, order),
                ReactorInput::Key(event) => self.engine.handle_key_event(now, event),
                ReactorInput::Done(done) => self.handle_done(now, done),
            }
        }
        if self.engine.follow_local_at() <= now && self.notices.take_graph() {
            let local = local_graph(&self.session);
            self.engine.handle_local_graph(now, local);
            busy = true;
        }
        if self.inputs.take_ring() {
            self.rings.arm();
            self.engine.handle_rings(now);
            busy = true;
        }
        busy
    }

    fn handle_order(&mut self, now: Duration, order: ToGateway) {
        match order {
            ToGateway::Shutdown => self.shutdown = true,
            ToGateway::Finish => {
                self.finishing.get_or_insert_with(|| ShutdownDrain::new(now));
            }
            order => self.engine.handle_order(now, order),
        }
    }

    fn handle_done(&mut self, now: Duration, done: TaskResult) {
        match done {
            TaskResult::Recorded(link, first) => self.engine.handle_recorded(now, link, first),
            TaskResult::Identity => self.engine.handle_identity(now),
            TaskResult::Interfaces(interfaces) => self.engine.handle_interfaces(interfaces),
            TaskResult::Compressed(answer) => self.engine.handle_compressed(now, answer),
            TaskResult::Keys(statistics) => {
                self.key_reports.handle_report();
                let (kme, used) = *statistics;
                if let Some(status) = self.engine.key_status(&kme, &used, now) {
                    self.told.tell(ToControl::Keys(status));
                }
            }
        }
    }

    /// Carries out the engine's effects.
    fn carry_out(&mut self, now: Duration) {
        while let Some(effect) = self.engine.poll_effect() {
            match effect {
                Effect::Tell(what) => self.told.tell(what),
                Effect::Kme(origin, request) => {
                    if let Some((kme, _)) = &self.kme
                        && let Err(event) = kme.submit(origin, request)
                    {
                        self.answers.push(*event);
                    }
                }
                Effect::Record { link, key_id } => self.record(link, key_id, now),
                Effect::Interfaces => self.list_interfaces(),
                Effect::Compress(order) => self.compressor.submit(order),
                Effect::ReturnMemory => {
                    tokio::spawn(async {
                        sleep(RETURN).await;
                        let _ = spawn_blocking(return_free_memory).await;
                    });
                }
            }
        }
    }

    fn record(&mut self, link: u64, key_id: String, now: Duration) {
        let Some((_, used)) = &self.kme else {
            return self.engine.handle_recorded(now, link, false);
        };
        let (used, report) = (used.clone(), self.report_done.clone());
        spawn_blocking(move || {
            let first = used.record(&[key_id]) == [true];
            // An error: the reactor is gone.
            let _ = report.send(TaskResult::Recorded(link, first));
        });
    }

    fn list_interfaces(&self) {
        let report = self.report_done.clone();
        spawn_blocking(move || {
            let found = interfaces().unwrap_or_else(|error| {
                tracing::warn!(%error, "cannot list the network interfaces: their limits do not act");
                Vec::new()
            });
            // An error: the reactor is gone.
            let _ = report.send(TaskResult::Interfaces(found));
        });
    }

    /// Sends packets, up to a bound. Returns whether there was any.
    fn transmit(&mut self, now: Duration) -> bool {
        self.has_packets = false;
        for sent in 0..MAX_SENDS {
            if !self.sockets.flush() {
                return sent > 0;
            }
            let most = self.sockets.max_datagrams();
            let packets = self.engine.poll_transmit(most, &mut self.buffer, now);
            let Some((socket, transmit)) = packets else { return sent > 0 };
            self.sockets.send(socket, transmit, &self.buffer);
        }
        self.has_packets = true;
        true
    }

    fn look_whether_finished(&mut self, now: Duration) {
        if let Some(finishing) = &mut self.finishing
            && finishing.poll_timeout() <= now
            && finishing.is_over(self.engine.backlog(), now)
        {
            self.finishing = None;
            self.told.tell(ToControl::Finished);
        }
    }

    /// Starts a read of the counters of the keys on another thread, because the ledger may wait for the disk.
    fn report_keys(&mut self, now: Duration) {
        let Some((kme, used)) = &self.kme else { return };
        if !self.key_reports.begin(now) {
            return;
        }
        let (kme, used, report) = (kme.clone(), used.clone(), self.report_done.clone());
        spawn_blocking(move || {
            let _ = report.send(TaskResult::Keys(Box::new((kme.statistics(), used.statistics()))));
        });
    }

    /// Waits until there is something to do. The pass before had work if it was `busy`.
    async fn wait(&mut self, busy: bool) {
        if std::mem::take(&mut self.is_flooded) && !busy {
            // This does not wait for inputs: each datagram would end the wait. It ends early for a due timer.
            let now = self.now();
            let due = self.engine.poll_timeout(now).map_or(REST, |due| due.saturating_sub(now));
            std::thread::sleep(REST.min(due));
        }
        let now = self.now();
        let finishing = self.finishing.as_ref().map(ShutdownDrain::poll_timeout);
        let keys = self.kme.as_ref().and_then(|_| self.key_reports.poll_timeout());
        let follow = self.notices.has_graph().then(|| self.engine.follow_local_at());
        let due = [self.engine.poll_timeout(now), finishing, keys, follow];
        let until = due.into_iter().flatten().min();
        if self.has_packets || until.is_some_and(|until| until <= now) {
            // The kernel is asked for readiness all the same.
            yield_now().await;
            let _ = self.look().await;
            return;
        }
        let end = match self.looks.after_pass(busy) {
            PollDecision::Not => return self.wait_until(until).await,
            PollDecision::For(time) => {
                Some(until.map_or(now + time, |until| until.min(now + time)))
            }
            PollDecision::On => until,
        };
        let found = self.look_until(end).await;
        self.looks.handle_look(found);
        if !found && until.is_none_or(|until| self.now() < until) {
            self.wait_until(until).await;
        }
    }

    /// Looks for an input until this time. Returns whether there is one.
    async fn look_until(&mut self, end: Option<Duration>) -> bool {
        loop {
            yield_now().await;
            if self.look().await {
                return true;
            }
            if end.is_some_and(|end| self.now() >= end) {
                return false;
            }
        }
    }

    /// Returns whether there is an input now.
    async fn look(&mut self) -> bool {
        let Self { inputs, sockets, notices, told, .. } = self;
        let reads = !told.is_behind();
        let (mut noticed, mut sent) = (pin!(notices.wait()), pin!(told.send_next()));
        poll_fn(|cx| {
            let ready = inputs.poll_ready(cx).is_ready()
                | (reads && sockets.poll_ready(cx).is_ready())
                | noticed.as_mut().poll(cx).is_ready()
                | sent.as_mut().poll(cx).is_ready();
            Poll::Ready(ready)
        })
        .await
    }

    /// Waits for inputs until this time at most.
    async fn wait_until(&mut self, until: Option<Duration>) {
        let left = until.map(|until| until.saturating_sub(self.now()));
        let Self { inputs, sockets, notices, told, timer, .. } = self;
        // Datagrams stay with the kernel while the control plane is far behind.
        let reads = !told.is_behind();
        let ready = poll_fn(|cx| {
            let ready =
                inputs.poll_ready(cx).is_ready() | (reads && sockets.poll_ready(cx).is_ready());
            if ready { Poll::Ready(()) } else { Poll::Pending }
        });
        tokio::select! {
            biased;
            () = ready => {}
            () = notices.wait() => {}
            () = told.send_next() => {}
            () = timer.wait(left) => {}
        }
    }
}

/// Looks at the files of the identity until the reactor is gone.
async fn watch_files(identity: Arc<Identity>, report: mpsc::UnboundedSender<TaskResult>) {
    let mut looks = tokio::time::interval(IDENTITY_CHECK_INTERVAL);
    // After a stall, two looks at once would miss a write in between.
    looks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    while !report.is_closed() {
        looks.tick().await;
        let identity = Arc::clone(&identity);
        // The work runs on another thread, because a file system can hang.
        let changed = spawn_blocking(move || identity.look(Instant::now())).await;
        if changed.unwrap_or(false) && report.send(TaskResult::Identity).is_err() {
            return;
        }
    }
}
