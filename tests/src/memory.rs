//! Searches the memory of another process for secrets.

use std::{
    collections::HashMap,
    fs::{self, File},
    io,
    os::unix::fs::FileExt,
    thread,
    time::Duration,
};

use rustix::process::{Pid, Signal, kill_process};

/// Length of a piece: shorter than any part of a secret worth having, too long to occur by chance.
const PIECE: usize = 8;
/// Number of bits of an index into a filter, which rules out most positions as the start of a piece.
const FILTER: u32 = 20;
const PAGE: usize = 4096;
/// Bytes of the stack of a thread that Rust's library or tokio makes. Other memory may follow in the
/// same mapping.
const STACK: usize = 2 << 20;

/// Secrets to search for, each in all forms in which a derivation handles it.
pub struct Needles {
    pieces: HashMap<u64, Secret>,
    filter: Vec<bool>,
}

/// The secret to which a piece belongs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Secret {
    /// The kind of secret.
    pub kind: &'static str,
    /// Which one of that kind.
    pub number: usize,
}

/// Adjacent pieces of one secret.
#[derive(Clone, Debug)]
pub struct Find {
    /// The secret of the pieces.
    pub secret: Secret,
    /// The address of the pieces.
    pub address: usize,
    /// Bytes from the first to the last.
    pub length: usize,
    /// The mapping's name; empty for anonymous memory.
    pub mapping: String,
    /// Whether the mapping is locked, left out of core files, and wiped in a forked child.
    pub guarded: bool,
    /// Whether the pieces are on the stack of a living thread.
    pub on_stack: bool,
}

impl Default for Needles {
    fn default() -> Self {
        Self { pieces: HashMap::new(), filter: vec![false; 1 << FILTER] }
    }
}

impl Needles {
    /// Adds a secret as it is, and as a hash function and HMAC have it: in words of the other byte
    /// order, and masked by the two pads (RFC 2104).
    pub fn add(&mut self, kind: &'static str, number: usize, bytes: &[u8]) {
        let secret = Secret { kind, number };
        for mask in [0x00, 0x36, 0x5c] {
            let masked: Vec<u8> = bytes.iter().map(|byte| byte ^ mask).collect();
            self.add_text(secret, &masked);
            let words = masked.chunks(4).flat_map(|word| word.iter().rev().copied());
            self.add_text(secret, &words.collect::<Vec<_>>());
        }
    }

    /// Adds a secret as it is.
    pub fn add_text(&mut self, secret: Secret, bytes: &[u8]) {
        for piece in bytes.windows(PIECE) {
            let piece = value(piece);
            self.filter[slot(piece)] = true;
            self.pieces.insert(piece, secret);
        }
    }

    fn find(&self, bytes: &[u8]) -> Option<Secret> {
        let piece = value(bytes);
        if self.filter[slot(piece)] { self.pieces.get(&piece).copied() } else { None }
    }
}

fn value(piece: &[u8]) -> u64 {
    u64::from_ne_bytes(piece.try_into().expect("the length of a piece"))
}

fn slot(piece: u64) -> usize {
    (piece.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> (64 - FILTER)) as usize
}

/// A writable mapping of a process.
struct Mapping {
    start: usize,
    end: usize,
    name: String,
    guarded: bool,
    /// The end of the part that is a stack; the start of the mapping if no part is a stack.
    stack_end: usize,
}

/// A process that is stopped until this is dropped.
#[derive(Debug)]
pub struct Stopped {
    pid: u32,
    process: Pid,
}

impl Stopped {
    /// Stops the process `pid`.
    ///
    /// # Errors
    /// The process is gone, or another user's.
    pub fn new(pid: u32) -> io::Result<Self> {
        let process = i32::try_from(pid).ok().and_then(Pid::from_raw);
        let process = process.ok_or(io::ErrorKind::InvalidInput)?;
        kill_process(process, Signal::STOP)?;
        let stopped = Self { pid, process };
        wait_stopped(pid)?;
        Ok(stopped)
    }

    /// Searches all of the process's writable memory: stacks, heaps, freed memory, and mappings. Needs the right to
    /// trace the process.
    ///
    /// # Errors
    /// The process is gone, or its memory may not be read.
    pub fn search(&self, needles: &Needles) -> io::Result<Vec<Find>> {
        search_stopped(self.pid, needles)
    }
}

impl Drop for Stopped {
    fn drop(&mut self) {
        // It may have been killed meanwhile.
        let _ = kill_process(self.process, Signal::CONT);
    }
}

/// Waits until no thread of the process runs.
fn wait_stopped(pid: u32) -> io::Result<()> {
    for thread in fs::read_dir(format!("/proc/{pid}/task"))? {
        let stat = thread?.path().join("stat");
        let state = || -> io::Result<Option<char>> {
            let text = fs::read_to_string(&stat)?;
            Ok(text.rsplit_once(')').and_then(|(_, rest)| rest.trim_start().chars().next()))
        };
        // A thread that ended meanwhile has no stat.
        while let Ok(Some(state)) = state()
            && state != 'T'
        {
            thread::sleep(Duration::from_millis(1));
        }
    }
    Ok(())
}

fn search_stopped(pid: u32, needles: &Needles) -> io::Result<Vec<Find>> {
    let memory = File::open(format!("/proc/{pid}/mem"))?;
    let pagemap = File::open(format!("/proc/{pid}/pagemap"))?;
    let stack_pointers = stack_pointers(pid)?;
    let mut found = Vec::new();
    for mut mapping in mappings(pid)? {
        if mapping.name == "[stack]" {
            mapping.stack_end = mapping.end;
        } else if stack_pointers.iter().any(|at| (mapping.start..mapping.end).contains(at)) {
            mapping.stack_end = mapping.end.min(mapping.start + STACK);
        }
        // Pieces may cross the border of two pages, so that present ones are searched in runs.
        let mut run = Vec::new();
        let mut start = mapping.start;
        for page in (mapping.start..mapping.end).step_by(PAGE) {
            let mut entry = [0; 8];
            pagemap.read_exact_at(&mut entry, (page / PAGE * 8) as u64)?;
            let mut bytes = [0; PAGE];
            // The page is present or swapped. A page that was never touched contains nothing.
            if u64::from_ne_bytes(entry) >> 62 != 0
                && memory.read_exact_at(&mut bytes, page as u64).is_ok()
            {
                run.extend_from_slice(&bytes);
            } else {
                search_run(&mapping, start, &run, needles, &mut found);
                run.clear();
                start = page + PAGE;
            }
        }
        search_run(&mapping, start, &run, needles, &mut found);
    }
    Ok(found)
}

fn search_run(
    mapping: &Mapping,
    start: usize,
    bytes: &[u8],
    needles: &Needles,
    found: &mut Vec<Find>,
) {
    let mut last: Option<Find> = None;
    for (at, piece) in bytes.windows(PIECE).enumerate() {
        let Some(secret) = needles.find(piece) else { continue };
        let address = start + at;
        match &mut last {
            Some(find) if find.secret == secret && address < find.address + find.length => {
                find.length = address + PIECE - find.address;
            }
            _ => {
                let (name, guarded) = (mapping.name.clone(), mapping.guarded);
                let on_stack = address < mapping.stack_end;
                let fresh =
                    Find { secret, address, length: PIECE, mapping: name, guarded, on_stack };
                found.extend(last.replace(fresh));
            }
        }
    }
    found.extend(last);
}

/// Returns the stack pointers of a stopped process's threads.
fn stack_pointers(pid: u32) -> io::Result<Vec<usize>> {
    let mut pointers = Vec::new();
    for thread in fs::read_dir(format!("/proc/{pid}/task"))? {
        // A thread that ended meanwhile has no stack.
        let Ok(text) = fs::read_to_string(thread?.path().join("syscall")) else { continue };
        // The last two fields are the stack pointer and the program counter.
        let pointer = text.split_whitespace().rev().nth(1).and_then(|at| at.strip_prefix("0x"));
        pointers.extend(pointer.and_then(|at| usize::from_str_radix(at, 16).ok()));
    }
    Ok(pointers)
}

fn mappings(pid: u32) -> io::Result<Vec<Mapping>> {
    let text = fs::read_to_string(format!("/proc/{pid}/smaps"))?;
    let mut mappings: Vec<Mapping> = Vec::new();
    let mut writable = false;
    for line in text.lines() {
        if let Some(flags) = line.strip_prefix("VmFlags:") {
            let flags: Vec<&str> = flags.split_whitespace().collect();
            if let Some(mapping) = mappings.last_mut().filter(|_| writable) {
                mapping.guarded = ["lo", "dd", "wf"].iter().all(|flag| flags.contains(flag));
            }
        } else if let Some((start, end, rest)) = header(line) {
            writable = rest.starts_with("rw");
            if writable {
                let name = rest.split_whitespace().nth(4).unwrap_or_default().to_owned();
                mappings.push(Mapping { start, end, name, guarded: false, stack_end: start });
            }
        }
    }
    Ok(mappings)
}

/// Parses the first line of a mapping, such as `7f0e-7f1e rw-p …`.
fn header(line: &str) -> Option<(usize, usize, &str)> {
    let (range, rest) = line.split_once(' ')?;
    let (start, end) = range.split_once('-')?;
    Some((usize::from_str_radix(start, 16).ok()?, usize::from_str_radix(end, 16).ok()?, rest))
}
