//! Looking for bytes in the memory of another process.

use std::collections::HashMap;
use std::fs::{self, File};
use std::os::unix::fs::FileExt;

use axon_tests::schedule::Secret;

/// Number of bytes of a secret that count as a find.
const PIECE: usize = 8;
const CHUNK: usize = 1 << 20;

/// Secrets to look for, cut into pieces.
pub(crate) struct Needles<'a> {
    secrets: &'a [Secret],
    pieces: HashMap<[u8; PIECE], usize>,
    /// Which first two bytes a piece can have.
    starts: Vec<bool>,
}

impl<'a> Needles<'a> {
    pub(crate) fn of(secrets: &'a [Secret]) -> Self {
        let mut pieces = HashMap::new();
        let mut starts = vec![false; 1 << 16];
        for (number, secret) in secrets.iter().enumerate() {
            for piece in secret.bytes.as_chunks::<PIECE>().0 {
                pieces.insert(*piece, number);
                starts[usize::from(u16::from_ne_bytes([piece[0], piece[1]]))] = true;
            }
        }
        Self { secrets, pieces, starts }
    }

    /// Returns the names of the secrets of which a piece is in the writable memory of a process.
    pub(crate) fn found_in(&self, process: u32) -> Vec<String> {
        let memory = File::open(format!("/proc/{process}/mem")).unwrap();
        let maps = fs::read_to_string(format!("/proc/{process}/maps")).unwrap();
        let mut found = vec![false; self.secrets.len()];
        let mut looked_at = 0;
        for map in maps.lines() {
            let mut fields = map.split_whitespace();
            let (range, rights) = (fields.next().unwrap(), fields.next().unwrap());
            if !rights.starts_with("rw") {
                continue;
            }
            let (start, end) = range.split_once('-').unwrap();
            let [start, end] = [start, end].map(|at| u64::from_str_radix(at, 16).unwrap());
            looked_at += self.look(&memory, start, end, &mut found);
        }
        assert!(looked_at > 1 << 20, "the memory of the child could be read: {looked_at} bytes");
        let names = self.secrets.iter().map(|secret| secret.name.clone());
        names.zip(found).filter_map(|(name, found)| found.then_some(name)).collect()
    }

    fn look(&self, memory: &File, start: u64, end: u64, found: &mut [bool]) -> u64 {
        let mut chunk = vec![0; CHUNK + PIECE - 1];
        let mut at = start;
        while at < end {
            let wanted = (end - at).min(chunk.len() as u64) as usize;
            // a page that was never touched, or a device, cannot be read
            let Ok(len) = memory.read_at(&mut chunk[..wanted], at) else { break };
            for window in chunk[..len].windows(PIECE) {
                if self.starts[usize::from(u16::from_ne_bytes([window[0], window[1]]))]
                    && let Some(number) = self.pieces.get(window)
                {
                    found[*number] = true;
                }
            }
            if len == 0 {
                break;
            }
            at += len.min(CHUNK) as u64;
        }
        at.min(end) - start
    }
}
