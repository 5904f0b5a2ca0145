//! Descriptors that processes pass to each other, and the way in which received descriptors are closed.
//!
//! The sender of a descriptor can make its close block for an arbitrary time: a TCP socket that lingers over unsent
//! data, a file of a user's own file system, or a unix socket with either of them in its queue. Therefore only
//! threads that have no other work close such descriptors.

use std::{
    fmt,
    io::{self, IoSliceMut},
    mem::MaybeUninit,
    os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd},
    sync::{Arc, atomic::Ordering},
};

use rustix::{
    fs::{fcntl_get_seals, fstat, stat},
    io::Errno,
    net::{
        RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, ReturnFlags, Shutdown, recvmsg,
        shutdown,
    },
    process::{Resource, WaitId, WaitIdOptions, getrlimit, waitid},
};

use super::closer::{self, FdClass, OPEN};

/// Size in blocks of 512 bytes below which a memfd is closed at once.
const SMALL: i64 = (1 << 20) / 512;
/// Maximum number of descriptors that the system allows in a packet.
const SCM_MAX_FD: usize = 253;
/// Maximum number of descriptors in a packet that [`receive_few`] receives.
pub const FEW_DESCRIPTORS: usize = 16;
/// Number of descriptors to keep free: more than a packet can carry, with other descriptors that a process opens
/// meanwhile. If this is more than half of the limit, half of the limit applies.
const RESERVE: u64 = 400;

/// A descriptor to be sent to another process, or [received](Self::received) from one. Dropping a received one does not
/// make the dropping thread wait for the close.
pub struct PassedFd {
    /// `None` only while it is dropped. Owned together with the values that [`share`](Self::share) returned.
    fd: Option<Arc<OwnedFd>>,
    origin: FdOrigin,
}

/// The origin of a descriptor, which decides how it is closed.
#[derive(Clone, Copy, PartialEq, Eq)]
enum FdOrigin {
    Own,
    /// Another process sent it.
    Passed,
    /// A socket whose queue may contain descriptors of other processes.
    Connection(FdClass),
}

impl PassedFd {
    /// Wraps a descriptor that another process sent, and that can be of any kind.
    pub fn received(fd: OwnedFd) -> Self {
        Self::new(fd, FdOrigin::Passed)
    }

    /// Wraps a connection, with the contents of its queue. When it is dropped, its other end learns that at once.
    pub fn connection(fd: OwnedFd) -> Self {
        Self::new(fd, FdOrigin::Connection(FdClass::Stranger))
    }

    /// Marks the connection as one of a process that may have a session.
    pub fn trusted(mut self) -> Self {
        self.origin = FdOrigin::Connection(FdClass::Session);
        self
    }

    fn new(fd: OwnedFd, origin: FdOrigin) -> Self {
        // The counter guards nothing: the functions that read it may miss descriptors that are opened or closed at the
        // moment.
        OPEN.fetch_add(1, Ordering::Relaxed);
        Self { fd: Some(Arc::new(fd)), origin }
    }

    /// Duplicates the descriptor.
    ///
    /// # Errors
    /// The process has no descriptors left.
    pub fn try_clone(&self) -> io::Result<Self> {
        Ok(Self::new(self.as_fd().try_clone_to_owned()?, self.origin_of_copy()))
    }

    /// Returns the same descriptor once more, within this process: it takes no further one, and is closed with the
    /// last of its values.
    #[must_use]
    pub fn share(&self) -> Self {
        Self { fd: self.fd.clone(), origin: self.origin_of_copy() }
    }

    /// Closes the descriptor at once if it is a copy of `other`, whose open file stays. A process that receives many
    /// copies together would otherwise hold all of them until another thread closes them.
    pub(crate) fn close_copy_of(mut self, other: &Self) {
        let file = |fd: &Self| fstat(fd).ok().map(|found| (found.st_dev, found.st_ino));
        if file(&self).is_some_and(|own| Some(own) == file(other)) {
            self.origin = FdOrigin::Own;
        }
    }

    fn origin_of_copy(&self) -> FdOrigin {
        match self.origin {
            // The connection must not end with a copy of its descriptor.
            FdOrigin::Connection(_) => FdOrigin::Passed,
            origin => origin,
        }
    }

    /// Returns whether it is memory that can be sealed, or a file of a tmpfs, which is as good. Calls no file system.
    pub fn is_memfd(&self) -> bool {
        fcntl_get_seals(self).is_ok()
    }

    /// Returns the device and inode of the file, if it is a memfd. Other file systems could delay the answer.
    pub fn memory(&self) -> Option<(u64, u64)> {
        let found = self.is_memfd().then(|| fstat(self).ok()).flatten()?;
        Some((found.st_dev, found.st_ino))
    }

    /// Returns whether it refers to a process. Takes no lock of the file behind it, which its sender could hold. Only a
    /// pidfd can be waited for, though only by the process's parent (Linux 5.4).
    pub fn is_pidfd(&self) -> bool {
        let look = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
        matches!(waitid(WaitId::PidFd(self.as_fd()), look), Ok(_) | Err(Errno::CHILD))
    }

    /// Returns the class that closes it; `None` if it can be closed at once. Calls no file system of another user,
    /// which could delay the answer.
    fn lane(&self) -> Option<FdClass> {
        match self.origin {
            FdOrigin::Own => None,
            FdOrigin::Connection(lane) => Some(lane),
            FdOrigin::Passed if self.is_memfd() => {
                let small = fstat(self).is_ok_and(|found| found.st_blocks < SMALL);
                (!small).then_some(FdClass::Memory)
            }
            FdOrigin::Passed => (!self.is_pidfd()).then_some(FdClass::Session),
        }
    }
}

impl From<OwnedFd> for PassedFd {
    /// Wraps a descriptor of this process.
    fn from(fd: OwnedFd) -> Self {
        Self::new(fd, FdOrigin::Own)
    }
}

impl AsFd for PassedFd {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.fd.as_ref().expect("it is not being dropped").as_fd()
    }
}

impl AsRawFd for PassedFd {
    fn as_raw_fd(&self) -> RawFd {
        self.as_fd().as_raw_fd()
    }
}

impl fmt::Debug for PassedFd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.as_fd().fmt(f)
    }
}

impl Drop for PassedFd {
    fn drop(&mut self) {
        if matches!(self.origin, FdOrigin::Connection(_)) {
            // This does not touch the queue, so it does not block, and the other end learns of the end before the
            // close.
            let _ = shutdown(&*self, Shutdown::Both);
        }
        let lane = self.lane();
        // Another value shares it: that one closes it.
        let Some(fd) = self.fd.take().and_then(Arc::into_inner) else { return };
        match lane {
            Some(lane) => lane.close(fd),
            None => {
                drop(fd);
                closer::closed();
            }
        }
    }
}

/// Returns whether there may be too few free descriptors for a packet, so that only [`receive_few`] should receive it.
/// The kernel closes descriptors that do not fit in the receiving thread.
pub fn is_tight() -> bool {
    let open = OPEN.load(Ordering::Relaxed);
    limit().is_some_and(|limit| open + RESERVE > limit)
}

/// Returns the maximum number of descriptors of this process: its soft RLIMIT_NOFILE. `None`: any number.
pub fn limit() -> Option<u64> {
    getrlimit(Resource::Nofile).current
}

/// Returns the number of open descriptors of this process, including those of its other threads.
pub fn open() -> u64 {
    const TABLE: &str = "/proc/self/fd";
    // Linux 6.2 and later return it without opening a descriptor.
    if let Ok(Ok(open @ 1..)) = stat(TABLE).map(|found| u64::try_from(found.st_size)) {
        return open;
    }
    // The listing includes its own descriptor.
    let listed = std::fs::read_dir(TABLE).map(|all| all.count() as u64);
    // If nothing can be opened, no descriptor is left.
    listed.unwrap_or_else(|_| limit().unwrap_or_else(|| OPEN.load(Ordering::Relaxed)))
}

fn reserve(limit: u64) -> u64 {
    RESERVE.min(limit / 2)
}

/// Returns whether so many descriptors from sessions wait to be closed that no more should be accepted.
pub fn is_clogged() -> bool {
    FdClass::Session.is_full()
}

/// Returns whether `limit`, the maximum number of open descriptors of this process, leaves no space for all that a
/// packet can carry: a peer that sends descriptors which are slow to close can then block this process.
pub fn is_scarce(limit: u64) -> bool {
    reserve(limit) < RESERVE
}

/// Returns whether so many connections of strangers wait to be closed that no connection should be accepted. If
/// descriptors are short, a few are too many, and descriptors from sessions count as well: waiting descriptors are
/// open.
pub fn close_queue_is_full() -> bool {
    let waits = || FdClass::Stranger.waiting().max(FdClass::Session.waiting());
    FdClass::Stranger.is_full() || (is_tight() && waits() >= FEW_DESCRIPTORS)
}

/// Returns half of the number of descriptors from other processes that this process can hold.
pub fn share() -> usize {
    let limit = limit().unwrap_or(u64::MAX);
    usize::try_from((limit - reserve(limit)) / 2).unwrap_or(usize::MAX)
}

/// A packet of a socket.
pub struct SocketPacket {
    /// The received length in bytes.
    pub bytes: usize,
    /// True if the packet was longer than the buffer.
    pub truncated: bool,
    /// True if this process could not hold all of its descriptors.
    pub lost: bool,
    /// The descriptors that came with it.
    pub descriptors: Vec<PassedFd>,
}

/// Receives one packet without waiting, with all descriptors that can come with it.
pub fn receive(socket: impl AsFd, buffer: &mut [u8]) -> Result<SocketPacket, Errno> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(SCM_MAX_FD))];
    receive_with(&socket, buffer, RecvFlags::empty(), &mut space)
}

fn receive_with(
    socket: impl AsFd,
    buffer: &mut [u8],
    how: RecvFlags,
    space: &mut [MaybeUninit<u8>],
) -> Result<SocketPacket, Errno> {
    let mut control = RecvAncillaryBuffer::new(space);
    let flags = RecvFlags::DONTWAIT | RecvFlags::CMSG_CLOEXEC | how;
    let got = loop {
        match recvmsg(&socket, &mut [IoSliceMut::new(buffer)], &mut control, flags) {
            Err(Errno::INTR) => {}
            other => break other?,
        }
    };
    let mut descriptors = Vec::new();
    for message in control.drain() {
        if let RecvAncillaryMessage::ScmRights(received) = message {
            descriptors.extend(received.map(PassedFd::received));
        }
    }
    Ok(SocketPacket {
        bytes: got.bytes,
        truncated: got.flags.contains(ReturnFlags::TRUNC),
        // The control buffer has space for the maximum number of descriptors.
        lost: got.flags.contains(ReturnFlags::CTRUNC),
        descriptors,
    })
}

/// Like [`receive`], but a packet stays in the socket if there is no space for its descriptors.
pub(crate) fn receive_whole(socket: impl AsFd, buffer: &mut [u8]) -> Result<SocketPacket, Errno> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(SCM_MAX_FD))];
    // Peeking duplicates the descriptors.
    let packet = receive_with(&socket, buffer, RecvFlags::PEEK, &mut space)?;
    if packet.lost {
        return Err(Errno::MFILE);
    }
    take_seen(&socket);
    Ok(packet)
}

/// Like [`receive`], for a packet of at most [`FEW_DESCRIPTORS`] descriptors: closes none of them for the last time,
/// and needs no space for more. A packet with more descriptors is reported as truncated and stays in the socket. If the
/// process has no space for the descriptors of a packet, the packet is reported as lost and stays, too.
pub fn receive_few(socket: impl AsFd, buffer: &mut [u8]) -> Result<SocketPacket, Errno> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(FEW_DESCRIPTORS))];
    let packet = receive_with(&socket, buffer, RecvFlags::PEEK, &mut space)?;
    // Because of its alignment, the space may fit one descriptor more.
    let more = packet.descriptors.len() > FEW_DESCRIPTORS;
    if !packet.lost && !more {
        take_seen(&socket);
    }
    let truncated =
        packet.truncated || more || packet.lost && packet.descriptors.len() == FEW_DESCRIPTORS;
    Ok(SocketPacket { truncated, lost: packet.lost || more, ..packet })
}

/// Takes a packet that was peeked at: its descriptors are not closed for the last time here.
fn take_seen(socket: impl AsFd) {
    let mut none = RecvAncillaryBuffer::default();
    let mut byte = [0];
    while let Err(Errno::INTR) =
        recvmsg(&socket, &mut [IoSliceMut::new(&mut byte)], &mut none, RecvFlags::DONTWAIT)
    {}
}

/// Copies the next packet of a socket, which stays there with its descriptors. Returns its length, as far as it fits.
pub fn look(socket: impl AsFd, buffer: &mut [u8]) -> Result<usize, Errno> {
    let flags = RecvFlags::DONTWAIT | RecvFlags::PEEK;
    let mut none = RecvAncillaryBuffer::default();
    Ok(recvmsg(socket, &mut [IoSliceMut::new(buffer)], &mut none, flags)?.bytes)
}

/// Returns whether the next packet of a socket has descriptors, which stay there: this closes nothing.
pub fn carries_descriptors(socket: impl AsFd) -> bool {
    let flags = RecvFlags::DONTWAIT | RecvFlags::PEEK;
    let mut byte = [0];
    let mut none = RecvAncillaryBuffer::default();
    recvmsg(socket, &mut [IoSliceMut::new(&mut byte)], &mut none, flags)
        .is_ok_and(|got| got.flags.contains(ReturnFlags::CTRUNC))
}

#[cfg(test)]
pub(crate) mod tests {
    use std::{
        io::{IoSlice, Write},
        net::{TcpListener, TcpStream},
        time::Duration,
    };

    use rustix::{
        fs::{MemfdFlags, memfd_create},
        net::{
            AddressFamily, SendAncillaryBuffer, SendAncillaryMessage, SendFlags, SocketFlags,
            SocketType, sendmsg, socketpair, sockopt,
        },
    };

    use super::*;

    /// Creates a socket whose last close takes hours, because it lingers over data that its peer does not read.
    pub(crate) fn reluctant() -> (OwnedFd, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        sockopt::set_socket_recv_buffer_size(&listener, 4096).unwrap();
        let mut ours = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let (peer, _) = listener.accept().unwrap();
        ours.set_nonblocking(true).unwrap();
        sockopt::set_socket_send_buffer_size(&ours, 4096).unwrap();
        while ours.write(&[0; 1 << 16]).is_ok() {}
        sockopt::set_socket_linger(&ours, Some(Duration::from_secs(10_000))).unwrap();
        (ours.into(), peer)
    }

    /// Sends a packet with a descriptor, to which only the receiver then has a reference.
    pub(crate) fn send_away(socket: impl AsFd, bytes: &[u8], fd: OwnedFd) {
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        let rights = [fd.as_fd()];
        assert!(control.push(SendAncillaryMessage::ScmRights(&rights)));
        sendmsg(socket, &[IoSlice::new(bytes)], &mut control, SendFlags::empty()).unwrap();
    }

    pub(crate) fn pair() -> (OwnedFd, OwnedFd) {
        socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None).unwrap()
    }

    /// Creates a unix socket whose queue has the last reference to a reluctant socket.
    fn hiding() -> (OwnedFd, TcpStream) {
        let (fd, peer) = reluctant();
        let (ours, theirs) = pair();
        send_away(&theirs, b"x", fd);
        (ours, peer)
    }

    fn await_end(of: &OwnedFd) {
        let mut byte = [0];
        assert_eq!(rustix::io::read(of, &mut byte), Ok(0), "it is closed in the end");
    }

    #[test]
    fn blocked_descriptor_closes_delay_no_other_descriptor_class() {
        let mut peers = Vec::new();
        for _ in 0..FdClass::Session.threads() + 2 {
            let (fd, peer) = hiding();
            drop(PassedFd::received(fd));
            peers.push(peer);
        }
        // All threads are blocked. A connection's other end learns of its end all the same.
        let (ours, theirs) = pair();
        drop(PassedFd::connection(ours).trusted());
        await_end(&theirs);
        // Memory has a thread of its own: a map that was never read is gone with its memfd.
        let memfd = memfd_create("test", MemfdFlags::CLOEXEC).unwrap();
        rustix::io::write(&memfd, &vec![1; 2 << 20]).unwrap();
        let path = format!("/proc/self/fd/{}", memfd.as_raw_fd());
        drop(PassedFd::received(memfd));
        while std::fs::read_link(&path).is_ok_and(|to| to.to_string_lossy().contains("memfd:test"))
        {
            std::thread::yield_now();
        }
        // Strangers have their own threads, too; they have as many connections.
        for _ in 0..FdClass::Stranger.threads() + 2 {
            let (fd, peer) = hiding();
            drop(PassedFd::connection(fd));
            peers.push(peer);
        }
        // Threads that were blocked go on when they can.
        peers.clear();
        let (ours, theirs) = pair();
        drop(PassedFd::received(ours));
        await_end(&theirs);
    }

    #[test]
    fn shared_descriptor_is_closed_with_its_last_value() {
        let (ours, theirs) = pair();
        let number = ours.as_raw_fd();
        let first = PassedFd::received(ours);
        let second = first.share();
        assert_eq!(second.as_raw_fd(), number, "no further descriptor");
        drop(first);
        rustix::io::write(&second, b"x").unwrap();
        let mut byte = [0];
        assert_eq!(rustix::io::read(&theirs, &mut byte), Ok(1));
        drop(second);
        await_end(&theirs);
        // The end of a connection is not put off by a shared value.
        let (ours, theirs) = pair();
        let connection = PassedFd::connection(ours).trusted();
        let shared = connection.share();
        drop(connection);
        await_end(&theirs);
        drop(shared);
    }

    #[test]
    fn a_socket_does_not_linger() {
        // More than there are threads: none of them is blocked.
        let mut peers = Vec::new();
        for _ in 0..FdClass::Session.threads() + 2 {
            let (fd, peer) = reluctant();
            drop(PassedFd::received(fd));
            peers.push(peer);
        }
        let (ours, theirs) = pair();
        drop(PassedFd::received(ours));
        await_end(&theirs);
    }

    #[test]
    fn to_ask_whether_descriptors_come_closes_none() {
        let (ours, theirs) = pair();
        assert!(!carries_descriptors(&ours), "nothing stands there");
        rustix::net::send(&theirs, b"x", SendFlags::empty()).unwrap();
        let (sent, kept) = pair();
        send_away(&theirs, b"x", sent);
        assert!(!carries_descriptors(&ours));
        receive(&ours, &mut [0; 1]).unwrap();
        assert!(carries_descriptors(&ours) && carries_descriptors(&ours));
        let flags = RecvFlags::DONTWAIT;
        assert_eq!(rustix::net::recv(&kept, &mut [0; 1], flags).err(), Some(Errno::AGAIN));
        let packet = receive(&ours, &mut [0; 1]).unwrap();
        assert!(packet.descriptors.len() == 1 && !packet.lost && !packet.truncated);
    }

    #[test]
    fn few_descriptors_are_received_with_their_packet_and_more_stay_where_they_are() {
        let (ours, theirs) = pair();
        let send = |count: usize| {
            let files: Vec<_> = (0..count).map(|_| tempfile::tempfile().unwrap()).collect();
            let rights: Vec<_> = files.iter().map(AsFd::as_fd).collect();
            let mut space =
                [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(FEW_DESCRIPTORS * 2))];
            let mut control = SendAncillaryBuffer::new(&mut space);
            assert!(control.push(SendAncillaryMessage::ScmRights(&rights)));
            sendmsg(&theirs, &[IoSlice::new(b"xy")], &mut control, SendFlags::empty()).unwrap();
        };
        send(FEW_DESCRIPTORS);
        send(FEW_DESCRIPTORS + 1);
        let mut buffer = [0; 2];
        let packet = receive_few(&ours, &mut buffer).unwrap();
        assert_eq!(
            (packet.bytes, packet.descriptors.len(), packet.lost),
            (2, FEW_DESCRIPTORS, false)
        );
        for _ in 0..2 {
            let packet = receive_few(&ours, &mut buffer).unwrap();
            assert!(packet.truncated && packet.lost, "it is still there");
        }
    }

    #[test]
    fn open_descriptors_are_counted() {
        let before = open();
        let files: Vec<_> = (0..50).map(|_| tempfile::tempfile().unwrap()).collect();
        // Other tests open and close meanwhile.
        assert!(open() >= before.saturating_sub(20) + 50 - 20, "{} of {before}", open());
        drop(files);
    }

    #[test]
    fn memfds_and_files_are_closed_in_their_class() {
        let memfd = memfd_create("test", MemfdFlags::CLOEXEC).unwrap();
        let memfd = PassedFd::received(memfd);
        assert_eq!(memfd.lane(), None);
        rustix::io::write(&memfd, &vec![1; 2 << 20]).unwrap();
        assert_eq!(memfd.lane(), Some(FdClass::Memory), "it gives much memory back");
        let file = PassedFd::received(tempfile::tempfile().unwrap().into());
        assert_eq!(file.lane(), Some(FdClass::Session));
    }

    #[test]
    fn only_a_pidfd_is_one() {
        use rustix::{
            event::{EventfdFlags, epoll, eventfd},
            process::{PidfdFlags, getpid, getppid, pidfd_open},
        };
        let of = |pid| PassedFd::received(pidfd_open(pid, PidfdFlags::empty()).unwrap());
        assert_eq!(of(getpid()).lane(), None);
        assert!(of(getpid()).is_pidfd() && of(getppid().unwrap()).is_pidfd());
        let mut child = std::process::Command::new("true").spawn().unwrap();
        let ended = of(rustix::process::Pid::from_child(&child));
        assert!(ended.is_pidfd());
        child.wait().unwrap();
        assert!(ended.is_pidfd(), "also of one that has ended");
        let others: [OwnedFd; 5] = [
            epoll::create(epoll::CreateFlags::CLOEXEC).unwrap(),
            eventfd(0, EventfdFlags::CLOEXEC).unwrap(),
            std::fs::File::open("/dev/null").unwrap().into(),
            // Its directory names a process, too.
            std::fs::File::open("/proc/self").unwrap().into(),
            pair().0,
        ];
        others.map(PassedFd::received).iter().for_each(|fd| assert!(!fd.is_pidfd(), "{fd:?}"));
    }
}
