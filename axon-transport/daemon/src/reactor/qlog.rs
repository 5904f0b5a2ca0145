//! Files of QUIC's events (`[link] qlog`), written on a thread of their own: a disk that is slow or full holds up no link.
//!
//! A file begins when its connection does. It has whole records up to its longest length. A connection whose events find
//! the queue to the disk full writes no more of them.

use std::{
    cell::Cell,
    collections::BTreeMap,
    fs::{self, DirBuilder, File, OpenOptions},
    io::{self, Write},
    os::unix::fs::{DirBuilderExt, OpenOptionsExt},
    path::{Path, PathBuf},
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    thread,
    time::{Duration, SystemTime},
};

use axon_shm::ids::DaemonId;

use crate::{engine::quic::qlog::Qlogs, link::Side};

/// The longest file, in bytes.
const MAX_FILE_BYTES: usize = 16 << 20;
/// Files in the directory. The oldest goes for a new one.
const MAX_FILES: usize = 64;
/// Number of bytes at which a connection passes its events on.
const TOGETHER: usize = 16 << 10;
/// Orders that wait for the disk.
const QUEUE: usize = 256;
/// Names of files begin and end with these.
const NAME: (&str, &str) = ("axon-", ".sqlog");

enum QlogOrder {
    /// Open a file of this name for a connection.
    Open(u64, String),
    /// Append whole records.
    Write(u64, Vec<u8>),
    /// No more events follow for this connection.
    Close(u64),
}

/// The files of one daemon.
pub(super) struct QlogFiles {
    orders: SyncSender<QlogOrder>,
    daemon: DaemonId,
    next: Cell<u64>,
}

/// Waits for the last writes.
pub(super) struct LastWrites(Receiver<()>);

impl QlogFiles {
    /// Begins to write to a directory, which is made if there is none.
    ///
    /// # Errors
    /// There is no thread for it.
    pub(super) fn start(directory: &Path, daemon: DaemonId) -> io::Result<(Self, LastWrites)> {
        let (orders, taken) = sync_channel(QUEUE);
        let (ending, ended) = sync_channel(1);
        let mut disk = Disk::new(directory);
        thread::Builder::new().name("axon-qlog".into()).spawn(move || {
            taken.iter().for_each(|order| disk.carry_out(order));
            drop(ending);
        })?;
        Ok((Self { orders, daemon, next: Cell::new(0) }, LastWrites(ended)))
    }
}

impl LastWrites {
    /// Waits until all is written that was handed on, but no longer than this. All writers are gone.
    pub(super) fn wait(self, most: Duration) {
        // Either error means that the wait is over.
        let _ = self.0.recv_timeout(most);
    }
}

impl Qlogs for QlogFiles {
    fn open(&self, side: Side) -> Option<Box<dyn Write + Send + Sync>> {
        let number = self.next.replace(self.next.get() + 1);
        let role = match side {
            Side::Client => "client",
            Side::Server => "server",
        };
        let daemon = &self.daemon.to_string()[..8];
        // The oldest is the first in the order of names.
        let (begin, end) = NAME;
        let since_epoch = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let unix_ms = since_epoch.map_or(0, |since| since.as_millis());
        let name = format!("{begin}{unix_ms:014}-{daemon}-{number:08}-{role}{end}");
        self.orders.try_send(QlogOrder::Open(number, name)).ok()?;
        Some(Box::new(EventWriter::new(number, self.orders.clone())))
    }
}

/// Collects the events of one connection.
struct EventWriter {
    number: u64,
    orders: SyncSender<QlogOrder>,
    buffer: Vec<u8>,
    /// Bytes of `buffer` that are whole records.
    whole: usize,
    /// Bytes that the file may still get.
    left: usize,
    is_over: bool,
}

impl EventWriter {
    fn new(number: u64, orders: SyncSender<QlogOrder>) -> Self {
        Self { number, orders, buffer: Vec::new(), whole: 0, left: MAX_FILE_BYTES, is_over: false }
    }

    fn hand_on(&mut self) {
        if self.whole == 0 || self.is_over {
            return;
        }
        let rest = self.buffer.split_off(self.whole);
        let records = std::mem::replace(&mut self.buffer, rest);
        self.left -= std::mem::take(&mut self.whole);
        self.is_over = self.orders.try_send(QlogOrder::Write(self.number, records)).is_err();
    }
}

impl Write for EventWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.buffer.len() + bytes.len() > self.left {
            self.hand_on();
            self.is_over = true;
        }
        if self.is_over {
            self.buffer = Vec::new();
            return Ok(bytes.len());
        }
        self.buffer.extend_from_slice(bytes);
        // A record ends with a line feed, and JSON has none within a string.
        if let Some(last) = bytes.iter().rposition(|byte| *byte == b'\n') {
            self.whole = self.buffer.len() - (bytes.len() - last - 1);
        }
        if self.whole >= TOGETHER {
            self.hand_on();
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        // QUIC asks for it after each event.
        Ok(())
    }
}

impl Drop for EventWriter {
    fn drop(&mut self) {
        self.hand_on();
        // If the queue is full, the file closes for a later one.
        let _ = self.orders.try_send(QlogOrder::Close(self.number));
    }
}

/// The directory, as the thread has it.
struct Disk {
    directory: PathBuf,
    /// The files that are being written, and their names.
    open: BTreeMap<u64, (String, File)>,
    /// Whether a failure was logged.
    is_said: bool,
}

impl Disk {
    fn new(directory: &Path) -> Self {
        Self { directory: directory.to_owned(), open: BTreeMap::new(), is_said: false }
    }

    fn carry_out(&mut self, order: QlogOrder) {
        let result = match order {
            QlogOrder::Open(number, name) => self.open(number, &name),
            QlogOrder::Write(number, records) => self.write(number, &records),
            QlogOrder::Close(number) => {
                self.open.remove(&number);
                Ok(())
            }
        };
        if let Err(error) = result
            && !std::mem::replace(&mut self.is_said, true)
        {
            tracing::warn!(directory = %self.directory.display(), %error,
                "could not write QUIC's events: some are missing. Further failures are not logged");
        }
    }

    fn open(&mut self, number: u64, name: &str) -> io::Result<()> {
        DirBuilder::new().recursive(true).mode(0o700).create(&self.directory)?;
        if self.open.len() >= MAX_FILES {
            return Err(io::Error::other(format!("{MAX_FILES} connections write already")));
        }
        self.make_room()?;
        let mut options = OpenOptions::new();
        let file = options.write(true).create_new(true).mode(0o600);
        let file = file.open(self.directory.join(name))?;
        self.open.insert(number, (name.to_owned(), file));
        Ok(())
    }

    /// Removes the oldest files of daemons until there is room for one more. Other files stay, and those that this
    /// daemon writes.
    fn make_room(&self) -> io::Result<()> {
        let mut names: Vec<_> = fs::read_dir(&self.directory)?
            .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
            .filter(|name| name.starts_with(NAME.0) && name.ends_with(NAME.1))
            .collect();
        names.sort_unstable();
        let too_many = (names.len() + 1).saturating_sub(MAX_FILES);
        names.retain(|name| self.open.values().all(|(open, _)| open != name));
        for name in names.iter().take(too_many) {
            match fs::remove_file(self.directory.join(name)) {
                // Another daemon removed it.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                removed => removed?,
            }
        }
        Ok(())
    }

    fn write(&mut self, number: u64, records: &[u8]) -> io::Result<()> {
        // A file that failed before gets no more.
        let Some((_, file)) = self.open.get_mut(&number) else { return Ok(()) };
        let written = file.write_all(records);
        if written.is_err() {
            self.open.remove(&number);
        }
        written
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(directory: &Path) -> Vec<String> {
        let entries = fs::read_dir(directory).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort_unstable();
        names
    }

    fn start(directory: &Path) -> (QlogFiles, LastWrites) {
        QlogFiles::start(directory, DaemonId([7; 16])).unwrap()
    }

    fn end(files: QlogFiles, last: LastWrites) {
        drop(files);
        last.wait(Duration::from_secs(60));
    }

    #[test]
    fn a_file_has_whole_records() {
        let dir = tempfile::tempdir().unwrap();
        let directory = dir.path().join("made");
        let (files, last) = start(&directory);
        let mut writer = files.open(Side::Client).unwrap();
        writer.write_all(b"one").unwrap();
        writer.write_all(b" record\nand half").unwrap();
        drop(writer);
        end(files, last);
        let names = names(&directory);
        assert_eq!(names.len(), 1, "{names:?}");
        assert!(names[0].ends_with("-07070707-00000000-client.sqlog"), "{names:?}");
        assert_eq!(fs::read(directory.join(&names[0])).unwrap(), b"one record\n");
    }

    #[test]
    fn a_file_ends_with_a_whole_record_before_it_is_too_long() {
        let (orders, taken) = sync_channel(2 * MAX_FILE_BYTES / TOGETHER);
        let mut writer = EventWriter::new(1, orders);
        let record = [&[b'x'; 999][..], b"\n"].concat();
        (0..2 * MAX_FILE_BYTES / record.len()).for_each(|_| writer.write_all(&record).unwrap());
        drop(writer);
        let written = taken.iter().map(|order| match order {
            QlogOrder::Write(1, records) => records.len(),
            _ => 0,
        });
        assert_eq!(written.sum::<usize>(), MAX_FILE_BYTES / record.len() * record.len());
    }

    #[test]
    fn the_oldest_qlog_files_are_deleted_and_foreign_files_are_kept() {
        let dir = tempfile::tempdir().unwrap();
        for other in ["notes.txt", "axon-notes.txt", "other.sqlog"] {
            fs::write(dir.path().join(other), "mine").unwrap();
        }
        fs::write(dir.path().join("axon-00000000000001-old.sqlog"), "").unwrap();
        let (files, last) = start(dir.path());
        for _ in 0..MAX_FILES + 5 {
            let mut writer = loop {
                // The queue may be full for a while.
                if let Some(writer) = files.open(Side::Client) {
                    break writer;
                }
                thread::yield_now();
            };
            writer.write_all(b"a record\n").unwrap();
        }
        end(files, last);
        let names = names(dir.path());
        assert_eq!(names.len(), MAX_FILES + 3, "{names:?}");
        assert!(!names.iter().any(|name| name.contains("old")), "{names:?}");
        assert!(names.contains(&"axon-notes.txt".to_owned()));
    }

    #[test]
    fn files_that_are_being_written_stay() {
        let dir = tempfile::tempdir().unwrap();
        let mut disk = Disk::new(dir.path());
        let name = |number: u64| format!("{}{number:014}{}", NAME.0, NAME.1);
        disk.carry_out(QlogOrder::Open(0, name(0)));
        for number in 1..2 * MAX_FILES as u64 {
            disk.carry_out(QlogOrder::Open(number, name(number)));
            disk.carry_out(QlogOrder::Close(number));
        }
        assert!(names(dir.path()).contains(&name(0)));
        assert_eq!(names(dir.path()).len(), MAX_FILES);
        for number in 200..300 {
            disk.carry_out(QlogOrder::Open(number, name(number)));
        }
        assert_eq!((disk.open.len(), names(dir.path()).len()), (MAX_FILES, MAX_FILES));
        assert!(disk.is_said && disk.open.contains_key(&0));
    }

    #[test]
    fn a_directory_that_cannot_be_and_a_full_disk_fail_no_write() {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("file"), "").unwrap();
        let (files, last) = start(&dir.path().join("file/below"));
        for _ in 0..3 {
            let mut writer = files.open(Side::Client).unwrap();
            writer.write_all(b"a record\n").unwrap();
        }
        end(files, last);

        let mut disk = Disk::new(dir.path());
        let full = OpenOptions::new().write(true).open("/dev/full").unwrap();
        disk.open.insert(1, ("full".to_owned(), full));
        disk.carry_out(QlogOrder::Write(1, b"a record\n".to_vec()));
        assert!(disk.is_said && disk.open.is_empty(), "it is given up");
        disk.carry_out(QlogOrder::Write(1, b"a record\n".to_vec()));
    }

    #[test]
    fn a_disk_that_hangs_costs_events_and_no_time() {
        let (orders, hanging) = sync_channel(2);
        let mut writer = EventWriter::new(1, orders);
        let record = [&[b'x'; TOGETHER - 1][..], b"\n"].concat();
        (0..100).for_each(|_| writer.write_all(&record).unwrap());
        assert!(writer.is_over && writer.buffer.is_empty());
        drop(writer);
        assert_eq!(hanging.iter().count(), 2);
    }
}
