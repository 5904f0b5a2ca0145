//! Another session as this session sees it: its mapped segments, its doorbell, and whether its process is alive.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs, io,
    os::fd::{AsFd, AsRawFd, BorrowedFd},
    sync::{
        Arc, Mutex, MutexGuard, OnceLock, PoisonError, Weak,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    process::{Pid, PidfdFlags, pidfd_open},
};

use crate::{
    alloc::segments::SegmentInfo,
    error::ShmError,
    ids::{Gid, SessionId},
    memory::{quota::Quota, segment::Map},
    os::descriptors::PassedFd,
    ring::{
        journal::Journal,
        layout::{self, Location, SegmentKind},
    },
    session::{attachment::Attachment, lane::LaneView, segment::SessionSegment},
    wake::{DoorbellSender, Purpose, due, waits},
};

/// The descriptors that a session hands over so that others can share memory with it, in the order in which they are
/// sent.
#[derive(Debug)]
pub struct PeerDescriptors {
    /// The first segment of its memory.
    pub segment: PassedFd,
    /// The doorbell that wakes it: one end of a pair of unix sockets that preserve packet boundaries.
    pub doorbell: PassedFd,
    /// The pidfd of its process.
    pub pidfd: PassedFd,
}

impl PeerDescriptors {
    /// Duplicates all of them.
    ///
    /// # Errors
    /// The process has no descriptors left.
    pub fn try_clone(&self) -> io::Result<Self> {
        Ok(Self {
            segment: self.segment.try_clone()?,
            doorbell: self.doorbell.try_clone()?,
            pidfd: self.pidfd.try_clone()?,
        })
    }

    /// Returns the process that the pidfd refers to, to be compared with the credentials of the socket that carried it.
    /// Returns `None` if it is no pidfd, or if its process has ended.
    ///
    /// # Errors
    /// The process has no descriptors left to look it up with.
    pub fn process(&self) -> io::Result<Option<u32>> {
        process(&self.pidfd)
    }

    /// Returns whether the pidfd is of the process that has this number in our PID namespace.
    ///
    /// # Errors
    /// No process has the number, or one of the two cannot be looked up.
    pub fn is_of(&self, pid: u32) -> io::Result<bool> {
        let number = i32::try_from(pid).ok().and_then(Pid::from_raw);
        let Some(number) = number else { return Ok(false) };
        let same = PassedFd::from(pidfd_open(number, PidfdFlags::empty())?);
        // The number of a process in /proc may differ from its number here: /proc may be of another namespace.
        let shown = process(&same)?;
        Ok(shown.is_some() && shown == self.process()?)
    }
}

fn process(pidfd: &PassedFd) -> io::Result<Option<u32>> {
    // For some kinds of descriptors, reading fdinfo takes locks that other processes can hold.
    if !pidfd.is_pidfd() {
        return Ok(None);
    }
    let path = format!("/proc/self/fdinfo/{}", pidfd.as_fd().as_raw_fd());
    let text = fs::read_to_string(path)?;
    let pid = text.lines().find_map(|line| line.strip_prefix("Pid:"));
    // -1 once the process has been reaped.
    Ok(pid.and_then(|pid| pid.trim().parse().ok()).filter(|pid| *pid > 0))
}

/// Maximum number of segments of another session that are kept, whatever it opens.
const MAX_SEGMENTS: usize = 4096;

/// Another session, mapped read-only.
pub struct PeerSession {
    id: SessionId,
    /// Its process when it was mapped.
    process: Option<u32>,
    /// The quota for memory of its process in this process.
    quota: Arc<Quota>,
    /// Its first segment.
    first: Arc<Map>,
    further: Mutex<FurtherSegments>,
    wanting: OnceLock<Box<dyn Fn() + Send + Sync>>,
    bell: DoorbellSender,
    pidfd: PassedFd,
    /// The last ticket of each of its armed words that this process rang for.
    rung: [AtomicU64; 2],
    /// Set when memory of the session came, for which readers may wait.
    changed: AtomicBool,
}

/// The segments besides the first.
#[derive(Default)]
struct FurtherSegments {
    /// The segments by number.
    maps: BTreeMap<u32, AnnouncedSegment>,
    /// The highest number of the segments that came.
    highest: u32,
    /// Segments that a reader needs and that have not been requested yet.
    wanted: BTreeSet<u32>,
    /// The readers, whose lanes show the session which of its segments they have.
    readers: Vec<Weak<Attachment>>,
    /// The number of readers at which dropped readers are removed.
    clean_at: usize,
    /// Number of subscribers of each publisher here, if no other code manages its memory.
    subscribed: BTreeMap<Gid, usize>,
}

/// A segment that the session has announced.
struct AnnouncedSegment {
    kind: SegmentKind,
    /// The map; absent if the segment could not be used.
    map: Option<Arc<Map>>,
}

/// The result of looking up a segment of another session.
pub(crate) enum SegmentLookup {
    Map(Arc<Map>),
    /// The segment was not valid.
    Refused,
    /// The segment has not come yet.
    Absent,
}

impl PeerSession {
    /// Checks and maps the first segment of session `id`.
    ///
    /// # Errors
    /// The descriptors are not those of a session, or not of this one. Or this process has too few descriptors, or too
    /// little address space, to use them now.
    pub fn map(id: SessionId, descriptors: PeerDescriptors) -> Result<Arc<Self>, ShmError> {
        Self::map_among(id, descriptors, [])
    }

    /// Like [`map`](Self::map), if `others` are mapped already: all sessions of one process share the address space of
    /// one.
    ///
    /// # Errors
    /// As for [`map`](Self::map).
    pub fn map_among<'a>(
        id: SessionId,
        descriptors: PeerDescriptors,
        others: impl IntoIterator<Item = &'a Arc<Self>>,
    ) -> Result<Arc<Self>, ShmError> {
        let PeerDescriptors { segment, doorbell, pidfd } = descriptors;
        let bell = DoorbellSender::received(doorbell).ok_or(ShmError::Refused {
            what: "its doorbell is no unix socket that keeps packets",
        })?;
        let process = process(&pidfd)
            .map_err(|source| ShmError::System { what: "looking up a process", source })?;
        let mut others = others.into_iter();
        let akin = others.find(|other| process.is_some() && other.process == process);
        let quota = akin.map_or_else(Quota::of_process, |akin| Arc::clone(&akin.quota));
        let first = Map::open(segment.as_fd(), &quota)?;
        layout::check_segment(first.words(), id, 0, SegmentKind::Session)?;
        Ok(Arc::new(Self {
            id,
            process,
            quota,
            first: Arc::new(first),
            further: Mutex::default(),
            wanting: OnceLock::new(),
            bell,
            pidfd,
            rung: Default::default(),
            changed: AtomicBool::new(false),
        }))
    }

    /// Checks and maps a further segment of the session. One that is mapped already stays.
    ///
    /// # Errors
    /// The segment is not what it was announced to be: rings that use it cannot be read. Or it cannot be mapped now: it
    /// counts as missing, and readers that need it request it again.
    pub fn add_segment(&self, info: SegmentInfo, segment: impl AsFd) -> Result<(), ShmError> {
        let mut further = self.further();
        let known = further.maps.contains_key(&info.number);
        if known || info.number == 0 || info.number > layout::MAX_NUMBER {
            return Ok(());
        }
        if further.maps.len() >= MAX_SEGMENTS {
            return Err(ShmError::Refused { what: "its session has too many segments" });
        }
        let map = Map::open(segment.as_fd(), &self.quota).and_then(|map| {
            layout::check_segment(map.words(), self.id, info.number, info.kind)?;
            Ok(Arc::new(map))
        });
        let (map, result) = match map {
            Ok(map) => (Some(map), Ok(())),
            Err(error @ ShmError::Refused { .. }) => (None, Err(error)),
            // The session did not cause this error.
            Err(error) => return Err(error),
        };
        further.maps.insert(info.number, AnnouncedSegment { kind: info.kind, map });
        further.wanted.remove(&info.number);
        further.highest = further.highest.max(info.number);
        let highest = further.highest;
        further.readers.retain(|reader| match reader.upgrade() {
            Some(reader) => {
                reader.set_mapped(highest);
                true
            }
            None => false,
        });
        // Pairs with `take_changed`: a thread that sees the flag finds the segment.
        self.changed.store(true, Ordering::Release);
        result
    }

    /// Returns whether memory of the session came since the last call.
    pub(crate) fn take_changed(&self) -> bool {
        // Loads first: there is seldom any. Pairs with the store in `add_segment`.
        self.changed.load(Ordering::Relaxed) && self.changed.swap(false, Ordering::Acquire)
    }

    /// Returns the journal of the session. A first segment that is too short for one has none, and then all rings are
    /// checked.
    pub(crate) fn journal(&self) -> Journal<'_, AtomicU64> {
        let words = self.first.words();
        let entries = words.get(layout::session::JOURNAL).unwrap_or_default();
        Journal { noted: &words[layout::session::NOTED], entries }
    }

    /// Forgets a segment that its session has closed. Samples in it stay for as long as they are in use.
    pub fn remove_segment(&self, number: u32) {
        self.further().maps.remove(&number);
    }

    /// Returns the segments that came, besides the first.
    pub fn segments(&self) -> Vec<SegmentInfo> {
        let further = self.further();
        let info = |(number, told): (&u32, &AnnouncedSegment)| SegmentInfo {
            number: *number,
            kind: told.kind,
        };
        further.maps.iter().map(info).collect()
    }

    /// Sets `ask`, which is called when a reader finds that a segment is missing; [`take_wanted`](Self::take_wanted)
    /// then returns the segment. It must not block.
    pub fn on_wanted(&self, ask: impl Fn() + Send + Sync + 'static) {
        let _ = self.wanting.set(Box::new(ask));
    }

    /// Returns the segments that readers need and that have not come, each once.
    pub fn take_wanted(&self) -> BTreeSet<u32> {
        std::mem::take(&mut self.further().wanted)
    }

    /// Returns whether a segment has come.
    pub fn has_segment(&self, number: u32) -> bool {
        !matches!(self.find(number), SegmentLookup::Absent)
    }

    pub(crate) fn find(&self, number: u32) -> SegmentLookup {
        if number == 0 {
            return SegmentLookup::Map(Arc::clone(&self.first));
        }
        match self.further().maps.get(&number) {
            Some(AnnouncedSegment { map: Some(map), .. }) => SegmentLookup::Map(Arc::clone(map)),
            Some(AnnouncedSegment { map: None, .. }) => SegmentLookup::Refused,
            None => SegmentLookup::Absent,
        }
    }

    /// Records that a reader needs a missing segment.
    pub(crate) fn want(&self, number: u32) {
        let mut further = self.further();
        let known = further.maps.contains_key(&number) || further.wanted.len() >= MAX_SEGMENTS;
        if !known && further.wanted.insert(number) {
            drop(further);
            if let Some(ask) = self.wanting.get() {
                ask();
            }
        }
    }

    /// Shows the highest number of the session's segments that came in the reader's lane: now, and whenever one comes.
    pub(crate) fn keep_told(&self, reader: &Arc<Attachment>) {
        let mut further = self.further();
        // Cleans up each time the number has doubled, since thousands of readers come one at a time.
        if further.readers.len() >= further.clean_at {
            further.readers.retain(|reader| reader.strong_count() > 0);
            further.clean_at = 2 * further.readers.len().max(8);
        }
        further.readers.push(Arc::downgrade(reader));
        reader.set_mapped(further.highest);
    }

    fn further(&self) -> MutexGuard<'_, FurtherSegments> {
        self.further.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the session's id.
    #[inline]
    pub fn id(&self) -> SessionId {
        self.id
    }

    /// Returns whether its process has ended. Costs a system call.
    pub fn is_dead(&self) -> bool {
        let mut fds = [PollFd::from_borrowed_fd(self.pidfd.as_fd(), PollFlags::IN)];
        poll(&mut fds, Some(&Timespec::default())).is_ok_and(|ready| ready > 0)
    }

    /// Returns the number of its process; `None` once the process has ended, or if it cannot be looked up.
    pub fn process(&self) -> Option<u32> {
        process(&self.pidfd).ok().flatten()
    }

    /// Returns whether it belonged to `process` when it was mapped.
    pub(crate) fn is_of(&self, process: u32) -> bool {
        self.process == Some(process)
    }

    /// Counts one more subscriber that needs the memory of a publisher's large samples.
    pub(crate) fn subscribe(&self, publisher: Gid) {
        *self.further().subscribed.entry(publisher).or_default() += 1;
    }

    /// Counts one subscriber less. With the last subscriber, the memory is dropped, except for samples in use.
    pub(crate) fn unsubscribe(&self, publisher: Gid) {
        let mut further = self.further();
        let Some(count) = further.subscribed.get_mut(&publisher) else { return };
        *count -= 1;
        if *count == 0 {
            further.subscribed.remove(&publisher);
            further.maps.retain(|_, told| told.kind != SegmentKind::Samples(publisher));
        }
    }

    /// Returns whether the two are sessions of one process.
    pub(crate) fn is_akin_to(&self, other: &Self) -> bool {
        self.id == other.id || (self.process.is_some() && self.process == other.process)
    }

    /// Returns the pidfd of its process, which is readable once the process has ended.
    pub fn pidfd(&self) -> BorrowedFd<'_> {
        self.pidfd.as_fd()
    }

    #[inline]
    fn ticket(&self, purpose: Purpose) -> &AtomicU64 {
        &self.first.words()[match purpose {
            Purpose::Samples => layout::session::ARMED,
            Purpose::Room => layout::session::BLOCKED,
        }]
    }

    #[inline]
    fn waits(&self, purpose: Purpose) -> bool {
        waits(self.ticket(purpose), &self.rung[purpose as usize])
    }

    fn ring_if(&self, purpose: Purpose) {
        let rung = &self.rung[purpose as usize];
        if due(self.ticket(purpose), rung) && !self.bell.ring() {
            // Relaxed: the next thread rings for any ticket, or another thread has rung.
            rung.store(0, Ordering::Relaxed);
        }
    }
}

/// The session at the other end of a ring.
#[derive(Clone)]
pub enum RingPeer {
    /// The very same session.
    Local(Arc<SessionSegment>),
    /// Another one, in this process or another.
    Remote(Arc<PeerSession>),
}

impl RingPeer {
    /// Returns the session's id.
    #[inline]
    pub fn id(&self) -> SessionId {
        match self {
            Self::Local(session) => session.id(),
            Self::Remote(session) => session.id(),
        }
    }

    /// Returns whether its process has ended; never true for this process.
    pub fn is_dead(&self) -> bool {
        match self {
            Self::Local(_) => false,
            Self::Remote(session) => session.is_dead(),
        }
    }

    #[inline]
    pub(crate) fn remote(&self) -> Option<&Arc<PeerSession>> {
        match self {
            Self::Local(_) => None,
            Self::Remote(session) => Some(session),
        }
    }

    /// Returns whether a thread there waits for `purpose` and this process has not rung for it yet.
    #[inline]
    pub(crate) fn waits(&self, purpose: Purpose) -> bool {
        match self {
            Self::Local(session) => session.waits(purpose),
            Self::Remote(session) => session.waits(purpose),
        }
    }

    /// Rings if a thread there waits for `purpose` and this process has not rung for it yet.
    #[inline]
    pub(crate) fn ring_if(&self, purpose: Purpose) {
        match self {
            Self::Local(session) => session.ring_if(purpose),
            Self::Remote(session) => session.ring_if(purpose),
        }
    }

    /// Returns the session's lane at this location.
    pub(crate) fn lane(&self, at: Location) -> Result<LaneView, ShmError> {
        match self.find(at.segment) {
            SegmentLookup::Map(map) => LaneView::new(&map, at),
            SegmentLookup::Refused | SegmentLookup::Absent => None,
        }
        .ok_or(ShmError::Refused { what: "it has no such lane" })
    }

    pub(crate) fn find(&self, number: u32) -> SegmentLookup {
        match self {
            Self::Local(session) => {
                session.map(number).map_or(SegmentLookup::Absent, SegmentLookup::Map)
            }
            Self::Remote(session) => session.find(number),
        }
    }
}
