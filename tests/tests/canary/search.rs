//! Finds pieces of keys in memory.

use std::collections::{BTreeMap, HashSet};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use crate::quarantine::Freed;

/// Length of a piece: shorter than any part of a key worth having, too long to occur by chance.
const PIECE: usize = 8;

/// Every piece of some keys, raw and as base64.
pub(crate) struct Needles {
    pieces: HashSet<[u8; PIECE]>,
    /// The first two bytes of each, to look up few.
    starts: Vec<bool>,
}

impl Needles {
    pub(crate) fn of<'k>(keys: impl IntoIterator<Item = &'k [u8]>) -> Self {
        let mut needles = Self { pieces: HashSet::new(), starts: vec![false; 1 << 16] };
        for key in keys {
            needles.add(key);
            needles.add(STANDARD.encode(key).as_bytes());
        }
        needles
    }

    fn add(&mut self, text: &[u8]) {
        for piece in text.windows(PIECE) {
            self.starts[start(piece)] = true;
            self.pieces.insert(piece.try_into().expect("the window's length"));
        }
    }

    /// Returns how many pieces are in `bytes`.
    pub(crate) fn count(&self, bytes: &[u8]) -> usize {
        let is_piece = |at: &&[u8]| self.starts[start(at)] && self.pieces.contains(*at);
        bytes.windows(PIECE).filter(is_piece).count()
    }
}

fn start(piece: &[u8]) -> usize {
    usize::from(piece[0]) << 8 | usize::from(piece[1])
}

/// The sites that allocated blocks with pieces of keys, with the number of blocks and of pieces.
#[derive(Default)]
pub(crate) struct Sites(pub(crate) BTreeMap<String, Found>);

/// The findings of one site.
#[derive(Default)]
pub(crate) struct Found {
    pub(crate) blocks: usize,
    pub(crate) pieces: usize,
    /// The stacks of the first block: its allocation and its release.
    pub(crate) stacks: String,
}

impl Sites {
    /// Looks through blocks.
    pub(crate) fn search(freed: &[Freed], needles: &Needles) -> Self {
        let mut sites = Self::default();
        for block in freed {
            let pieces = needles.count(&block.bytes());
            if pieces == 0 {
                continue;
            }
            let born = block.born.as_ref();
            let site = born.map_or_else(|| "before the call".to_owned(), |trace| trace.site());
            let found = sites.0.entry(site).or_default();
            found.blocks += 1;
            found.pieces += pieces;
            if found.stacks.is_empty() {
                let born = born.map(|trace| trace.names().join("\n    ")).unwrap_or_default();
                let died = block.died.names().join("\n    ");
                found.stacks = format!("  asked for by\n    {born}\n  given back by\n    {died}");
            }
        }
        sites
    }
}
