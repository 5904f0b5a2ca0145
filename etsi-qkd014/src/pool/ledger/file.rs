//! A ledger in a file: a header of 32 bytes, then a SHA-256 for each key_ID.
//!
//! A batch is written after the last whole record and flushed to stable storage before its keys may be used. A crash in
//! between may leave a part of the batch, zeros or nothing. That does no harm, because its keys were never handed out.

use std::collections::HashSet;
use std::fs::{File, OpenOptions};
use std::io::{self, BufReader, Read};
use std::os::unix::fs::{FileExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, OFlags, flock};
use rustix::io::Errno;

use super::{LedgerError, Sha, Short, short};

/// As long as a record, so that no record crosses a disk block.
const HEADER: &[u8; RECORD] = b"etsi-qkd014 ledger of key_IDs 1\n";
const RECORD: usize = 32;

pub(super) struct FileLedger {
    path: PathBuf,
    file: File,
    /// Bytes of the header and the whole records that are on stable storage.
    good: u64,
    /// True if the file may contain more than `good` bytes.
    torn: bool,
    /// True if the system failed to flush a write to stable storage. The system may report that only once, so another
    /// attempt proves nothing.
    broken: bool,
    seen: HashSet<Short>,
    /// Number of records after which the file becomes the older one and a new one begins.
    capacity: usize,
    /// The records of the older file.
    older: HashSet<Short>,
}

impl FileLedger {
    pub(super) fn open(path: PathBuf, capacity: usize) -> Result<Self, LedgerError> {
        match Self::open_at(&path) {
            Ok(Ok(mut this)) => {
                this.capacity = capacity.max(1);
                if capacity != usize::MAX {
                    this.older = older(&older_path(&path))?;
                }
                Ok(this)
            }
            Ok(refused) => refused,
            Err(source) => Err(LedgerError::Open { path, source }),
        }
    }

    fn open_at(path: &Path) -> io::Result<Result<Self, LedgerError>> {
        let file = private().create(true).truncate(false).open(path)?;
        let meta = file.metadata()?;
        let path = path.to_owned();
        if !meta.is_file() {
            return Ok(Err(LedgerError::NotALedger { path, reason: "it is no regular file" }));
        }
        match flock(&file, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => {}
            Err(Errno::WOULDBLOCK) => return Ok(Err(LedgerError::Locked { path })),
            Err(errno) => return Err(errno.into()),
        }
        if meta.mode() & 0o077 != 0 {
            return Ok(Err(LedgerError::NotPrivate { path, mode: meta.mode() & 0o7777 }));
        }
        let mut this = Self::over(path, file);
        if this.load()? {
            return Ok(Ok(this));
        }
        Ok(Err(LedgerError::NotALedger { path: this.path, reason: "it begins otherwise" }))
    }

    fn over(path: PathBuf, file: File) -> Self {
        let (seen, older) = Default::default();
        let capacity = usize::MAX;
        Self { path, file, good: 0, torn: false, broken: false, seen, capacity, older }
    }

    /// Reads the file and cuts off a torn record. Returns false if the file is no ledger.
    fn load(&mut self) -> io::Result<bool> {
        let mut reader = BufReader::with_capacity(1 << 16, &self.file);
        let mut begin = Vec::with_capacity(RECORD);
        (&mut reader).take(RECORD as u64).read_to_end(&mut begin)?;
        if !HEADER.starts_with(&begin) {
            return Ok(false);
        }
        if begin.len() < RECORD {
            // The file is new, or was torn when it was created.
            self.file.write_all_at(HEADER, 0)?;
            self.file.sync_all()?;
            self.sync_directory()?;
            self.good = RECORD as u64;
            return Ok(true);
        }
        let records = records(&mut reader, &mut self.seen)?;
        let good = (records + 1) * RECORD as u64;
        self.good = good;
        // After a crash, even whole records may be only in the system's memory.
        self.file.set_len(good)?;
        self.file.sync_all()?;
        Ok(true)
    }

    /// Flushes the directory, because the name of a new file must survive a crash, too.
    fn sync_directory(&self) -> io::Result<()> {
        let parent = self.path.parent().filter(|parent| !parent.as_os_str().is_empty());
        File::open(parent.unwrap_or(Path::new(".")))?.sync_all()
    }

    pub(super) fn len(&self) -> usize {
        self.seen.len() + self.older.len()
    }

    pub(super) fn contains(&self, short: &Short) -> bool {
        self.seen.contains(short) || self.older.contains(short)
    }

    /// Makes the full file the older one, whose records replace those of the previous older file. If this fails
    /// halfway, records go on into the file under its new name, and the next record tries again.
    fn turn(&mut self) -> io::Result<()> {
        match std::fs::rename(&self.path, older_path(&self.path)) {
            Ok(()) => {}
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(error),
        }
        let file = private().create_new(true).open(&self.path)?;
        flock(&file, FlockOperation::NonBlockingLockExclusive)?;
        file.write_all_at(HEADER, 0)?;
        file.sync_all()?;
        self.file = file;
        (self.good, self.torn) = (RECORD as u64, false);
        self.older = std::mem::take(&mut self.seen);
        self.sync_directory()
    }

    pub(super) fn record(&mut self, shas: &[Sha]) -> Result<Vec<bool>, LedgerError> {
        if self.broken {
            return Err(LedgerError::Broken { path: self.path.clone() });
        }
        let mut batch = HashSet::new();
        let mut bytes = Vec::new();
        let mut new = Vec::with_capacity(shas.len());
        for sha in shas {
            let is_new = !self.contains(&short(sha)) && batch.insert(short(sha));
            if is_new {
                bytes.extend_from_slice(sha);
            }
            new.push(is_new);
        }
        if !bytes.is_empty() {
            let written = self.append(&bytes);
            written.map_err(|source| LedgerError::Write { path: self.path.clone(), source })?;
            self.seen.extend(batch);
            if self.seen.len() >= self.capacity {
                // The records are written in any case; the file is only longer than it should be.
                let _ = self.turn();
            }
        }
        Ok(new)
    }

    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        if self.torn {
            self.cut()?;
        }
        if let Err(error) = self.file.write_all_at(bytes, self.good) {
            self.torn = true;
            // If this fails, too, it is tried again before the next write.
            let _ = self.cut();
            return Err(error);
        }
        if let Err(error) = self.file.sync_data() {
            self.broken = true;
            return Err(error);
        }
        self.good += bytes.len() as u64;
        Ok(())
    }

    fn cut(&mut self) -> io::Result<()> {
        self.file.set_len(self.good)?;
        self.torn = false;
        Ok(())
    }
}

/// Returns options to open a file that only its owner may read, and that is no symbolic link.
fn private() -> OpenOptions {
    let mut options = OpenOptions::new();
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    options.read(true).write(true).mode(0o600).custom_flags(flags.bits() as i32);
    options
}

/// Returns the path of the older file.
fn older_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".old");
    name.into()
}

/// Returns the records of the older file; empty if there is none.
fn older(path: &Path) -> Result<HashSet<Short>, LedgerError> {
    let mut seen = HashSet::new();
    let read = |seen: &mut HashSet<Short>| -> io::Result<bool> {
        let mut reader = BufReader::with_capacity(1 << 16, private().open(path)?);
        let mut begin = [0; RECORD];
        reader.read_exact(&mut begin)?;
        records(&mut reader, seen)?;
        Ok(&begin == HEADER)
    };
    match read(&mut seen) {
        Ok(true) => Ok(seen),
        Ok(false) => {
            Err(LedgerError::NotALedger { path: path.to_owned(), reason: "it begins otherwise" })
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(seen),
        Err(source) => Err(LedgerError::Open { path: path.to_owned(), source }),
    }
}

/// Reads whole records to the end, and returns their number.
fn records(reader: &mut impl Read, seen: &mut HashSet<Short>) -> io::Result<u64> {
    let mut record = [0; RECORD];
    let mut count = 0;
    loop {
        let mut have = 0;
        while have < RECORD {
            match reader.read(&mut record[have..])? {
                0 => return Ok(count),
                n => have += n,
            }
        }
        seen.insert(short(&record));
        count += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Ledger, sha};
    use super::*;

    fn temp() -> (tempfile::TempDir, PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("ledger");
        (dir, path)
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_device_that_takes_nothing_is_an_error_and_no_key_is_new() {
        let full = OpenOptions::new().read(true).write(true).open("/dev/full").unwrap();
        let mut ledger = FileLedger::over("/dev/full".into(), full);
        for _ in 0..3 {
            let error = ledger.record(&[sha("a")]).unwrap_err();
            assert!(matches!(error, LedgerError::Write { .. }), "{error}");
            assert_eq!(ledger.len(), 0);
        }
    }

    #[test]
    fn a_storage_that_lost_a_write_is_not_trusted_again() {
        // The state after a failed fdatasync.
        let (_dir, path) = temp();
        let mut ledger = FileLedger::open(path, usize::MAX).unwrap();
        ledger.broken = true;
        assert!(matches!(ledger.record(&[sha("a")]), Err(LedgerError::Broken { .. })));
    }

    #[test]
    fn a_ledger_cut_at_any_byte_opens_with_its_whole_records() {
        let (_dir, path) = temp();
        let ids = ["a", "b", "c"];
        Ledger::file(&path).unwrap().record(ids).unwrap();
        let whole = std::fs::read(&path).unwrap();
        assert_eq!(whole.len(), 4 * RECORD);
        for cut in 0..=whole.len() {
            std::fs::write(&path, &whole[..cut]).unwrap();
            let kept = (cut / RECORD).saturating_sub(1);
            let ledger = Ledger::file(&path).unwrap();
            assert_eq!(ledger.len(), kept, "cut at {cut}");
            let new: Vec<bool> = (0..3).map(|i| i >= kept).collect();
            assert_eq!(ledger.record(ids).unwrap(), new, "cut at {cut}");
            drop(ledger);
            assert_eq!(std::fs::read(&path).unwrap(), whole, "cut at {cut}");
        }
    }

    #[test]
    fn a_bounded_ledger_remembers_the_last_of_its_capacity_over_any_restart() {
        let (dir, path) = temp();
        for first in 0..12 {
            // Opened again for every two records.
            let ledger = Ledger::file_of(&path, 5).unwrap();
            for id in [2 * first, 2 * first + 1] {
                assert_eq!(ledger.record([id.to_string()]).unwrap(), [true]);
            }
            let last = 2 * first + 1;
            for known in (last + 1_usize).saturating_sub(5)..=last {
                assert!(ledger.contains(&known.to_string()), "{known} of {last}");
                assert_eq!(ledger.record([known.to_string()]).unwrap(), [false]);
            }
            assert!(ledger.len() <= 10);
        }
        for file in std::fs::read_dir(dir.path()).unwrap() {
            let meta = file.unwrap().metadata().unwrap();
            assert_eq!(meta.mode() & 0o7777, 0o600);
            assert!(meta.len() <= (RECORD * 6) as u64);
        }
        std::fs::write(older_path(&path), "junk that is longer than the header of a ledger")
            .unwrap();
        assert!(matches!(Ledger::file_of(&path, 5), Err(LedgerError::NotALedger { .. })));
        std::fs::remove_file(older_path(&path)).unwrap();
        assert!(Ledger::file_of(&path, 5).is_ok());
    }

    #[test]
    fn a_ledger_that_cannot_turn_its_file_goes_on_in_it() {
        let (_dir, path) = temp();
        let ledger = Ledger::file_of(&path, 2).unwrap();
        // A directory is in the way.
        std::fs::create_dir(older_path(&path)).unwrap();
        std::fs::write(older_path(&path).join("x"), "").unwrap();
        for id in ["a", "b", "c", "d"] {
            assert_eq!(ledger.record([id]).unwrap(), [true]);
        }
        assert_eq!(ledger.record(["a", "d"]).unwrap(), [false, false]);
        std::fs::remove_dir_all(older_path(&path)).unwrap();
        assert_eq!(ledger.record(["e"]).unwrap(), [true]);
        drop(ledger);
        let ledger = Ledger::file_of(&path, 2).unwrap();
        assert_eq!(ledger.record(["a", "b", "c", "d", "e", "f"]).unwrap()[..5], [false; 5]);
    }

    #[test]
    fn a_file_that_is_no_ledger_stays_unchanged() {
        let (dir, path) = temp();
        for text in ["x", "someone's diary, which is a good deal longer than the header is"] {
            std::fs::write(&path, text).unwrap();
            use std::os::unix::fs::PermissionsExt;
            std::fs::set_permissions(&path, PermissionsExt::from_mode(0o600)).unwrap();
            let error = Ledger::file(&path).unwrap_err();
            assert!(matches!(error, LedgerError::NotALedger { .. }), "{error}");
            assert_eq!(std::fs::read_to_string(&path).unwrap(), text);
        }
        let link = dir.path().join("link");
        std::os::unix::fs::symlink(&path, &link).unwrap();
        assert!(matches!(Ledger::file(&link), Err(LedgerError::Open { .. })));
        assert!(matches!(Ledger::file(dir.path()), Err(LedgerError::Open { .. })));
        assert!(matches!(Ledger::file("/dev/null"), Err(LedgerError::NotALedger { .. })));
        assert!(matches!(Ledger::file(dir.path().join("no/where")), Err(LedgerError::Open { .. })));
    }

    #[test]
    fn a_ledger_that_others_may_touch_is_refused_and_a_new_one_is_private() {
        use std::os::unix::fs::PermissionsExt;
        let (_dir, path) = temp();
        drop(Ledger::file(&path).unwrap());
        assert_eq!(std::fs::metadata(&path).unwrap().mode() & 0o7777, 0o600);
        for mode in [0o640, 0o602, 0o604] {
            std::fs::set_permissions(&path, PermissionsExt::from_mode(mode)).unwrap();
            let error = Ledger::file(&path).unwrap_err();
            assert!(error.to_string().contains("chmod 600"), "{error}");
        }
    }

    #[test]
    fn one_ledger_at_a_time_has_the_file_and_the_next_knows_all() {
        let (_dir, path) = temp();
        let first = Ledger::file(&path).unwrap();
        first.record(["a"]).unwrap();
        assert!(matches!(Ledger::file(&path), Err(LedgerError::Locked { .. })));
        drop(first);
        let second = Ledger::file(&path).unwrap();
        assert_eq!(second.record(["A", "b"]).unwrap(), [false, true]);
    }
}
