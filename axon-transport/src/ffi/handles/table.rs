//! Handles for C: numbers that name an object. The table detects a handle whose object no longer exists.
//!
//! A handle consists of an index in a table and the generation of that index, which rises whenever the index is
//! freed. It also contains the kind of the object and the process that created it. So a handle that is null, stale,
//! destroyed twice, of another kind or made up names no object, and no function ever follows it as a pointer. A
//! named object lives for as long as a call uses it, even if another thread destroys the handle meanwhile.

use std::sync::{Arc, Mutex, OnceLock, PoisonError, RwLock};

/// Places in the first block; each further block has twice as many. A block is allocated when it is needed
/// and never freed.
const FIRST: usize = 64;
/// The most blocks: a million objects of one kind in one process.
const BLOCKS: usize = 14;

/// The bits of a handle's parts, from the least significant bit on: place, kind, process, generation.
const PLACE: u32 = 20;
const KIND: u32 = 4;
const PROCESS: u32 = 12;
const GENERATIONS: u32 = u32::MAX >> (PLACE + KIND + PROCESS - 32);

/// The bits of a handle that distinguish a process from its ancestors and forked children.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::ffi) struct Process(u16);

impl Process {
    pub(in crate::ffi) const fn new(number: u64) -> Self {
        Self((number & ((1 << PROCESS) - 1)) as u16)
    }
}

/// Why a handle names no object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::ffi) enum Unknown {
    /// The handle is 0.
    Null,
    /// The handle is of this other kind.
    OtherKind(u8),
    /// The handle has the number of another process, perhaps of the parent of this one.
    Foreign(Process),
    /// The handle was destroyed, or never existed.
    Gone,
}

/// The objects of one kind, by handle. A look-up takes only the lock of one place. Only the creation and the
/// destruction of the object there hold that lock for writing.
pub(in crate::ffi) struct HandleTable<T> {
    kind: u8,
    process: Process,
    blocks: [OnceLock<Box<[HandleSlot<T>]>>; BLOCKS],
    free: Mutex<Free>,
}

struct HandleSlot<T>(RwLock<Content<T>>);

struct Content<T> {
    /// The generation of the object at this place, or of the next one if the place is free.
    generation: u32,
    object: Option<Arc<T>>,
}

struct Free {
    /// Free places that were used before, the newest last.
    places: Vec<usize>,
    /// The first place that was never used.
    fresh: usize,
}

impl<T> HandleTable<T> {
    pub(in crate::ffi) const fn new(kind: u8, process: Process) -> Self {
        assert!(kind < 1 << KIND);
        Self {
            kind,
            process,
            blocks: [const { OnceLock::new() }; BLOCKS],
            free: Mutex::new(Free { places: Vec::new(), fresh: 0 }),
        }
    }

    /// Inserts `object` and returns its handle, which is never 0. Returns `None` if the table is full.
    pub(in crate::ffi) fn insert(&self, object: T) -> Option<u64> {
        let index = {
            let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
            match free.places.pop() {
                Some(index) => index,
                None if free.fresh < FIRST * ((1 << BLOCKS) - 1) => {
                    free.fresh += 1;
                    free.fresh - 1
                }
                None => return None,
            }
        };
        let (block, within) = split(index);
        let block = self.blocks[block].get_or_init(|| {
            let vacant = || HandleSlot(RwLock::new(Content { generation: 1, object: None }));
            std::iter::repeat_with(vacant).take(FIRST << block).collect()
        });
        let mut content = block[within].0.write().unwrap_or_else(PoisonError::into_inner);
        content.object = Some(Arc::new(object));
        let process = u64::from(self.process.0) << (PLACE + KIND);
        let generation = u64::from(content.generation) << (PLACE + KIND + PROCESS);
        Some(generation | process | u64::from(self.kind) << PLACE | index as u64)
    }

    /// Returns the object that `handle` names.
    pub(in crate::ffi) fn get(&self, handle: u64) -> Result<Arc<T>, Unknown> {
        let (place, generation) = self.place(handle)?;
        let content = place.0.read().unwrap_or_else(PoisonError::into_inner);
        match &content.object {
            Some(object) if content.generation == generation => Ok(Arc::clone(object)),
            _ => Err(Unknown::Gone),
        }
    }

    /// Runs `visit` on the object that `handle` names. A signal handler may call this: the call neither
    /// allocates nor frees memory, and does not block. An object that is being created or destroyed at this
    /// moment counts as [`Unknown::Gone`].
    pub(in crate::ffi) fn visit<R>(
        &self,
        handle: u64,
        visit: impl FnOnce(&T) -> R,
    ) -> Result<R, Unknown> {
        let (place, generation) = self.place(handle)?;
        let Ok(content) = place.0.try_read() else { return Err(Unknown::Gone) };
        match &content.object {
            Some(object) if content.generation == generation => Ok(visit(object)),
            _ => Err(Unknown::Gone),
        }
    }

    /// Removes the handle and returns its object, which ends when no call uses it any more.
    pub(in crate::ffi) fn remove(&self, handle: u64) -> Result<Arc<T>, Unknown> {
        let (place, generation) = self.place(handle)?;
        let mut content = place.0.write().unwrap_or_else(PoisonError::into_inner);
        if content.generation != generation {
            return Err(Unknown::Gone);
        }
        let object = content.object.take().ok_or(Unknown::Gone)?;
        // A place is never used again once its generations are used up.
        if content.generation < GENERATIONS {
            content.generation += 1;
            drop(content);
            let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
            free.places.push((handle & ((1 << PLACE) - 1)) as usize);
        }
        Ok(object)
    }

    /// Returns the place and the generation of a handle.
    fn place(&self, handle: u64) -> Result<(&HandleSlot<T>, u32), Unknown> {
        if handle == 0 {
            return Err(Unknown::Null);
        }
        let part = |from: u32, bits: u32| (handle >> from) & ((1 << bits) - 1);
        let kind = part(PLACE, KIND) as u8;
        if kind != self.kind {
            return Err(Unknown::OtherKind(kind));
        }
        let process = Process::new(part(PLACE + KIND, PROCESS));
        if process != self.process {
            return Err(Unknown::Foreign(process));
        }
        let (block, within) = split(part(0, PLACE) as usize);
        let place = self.blocks.get(block).and_then(OnceLock::get).and_then(|b| b.get(within));
        let generation = (handle >> (PLACE + KIND + PROCESS)) as u32;
        place.map(|place| (place, generation)).ok_or(Unknown::Gone)
    }
}

/// Splits an index into the block and the position in that block.
fn split(index: usize) -> (usize, usize) {
    let block = (index / FIRST + 1).ilog2() as usize;
    (block, index - FIRST * ((1 << block) - 1))
}

#[cfg(test)]
mod tests {
    use std::{
        collections::HashMap,
        sync::atomic::{AtomicUsize, Ordering},
        thread,
    };

    use proptest::prelude::*;

    use super::*;

    fn table<T>() -> HandleTable<T> {
        HandleTable::new(3, Process::new(7))
    }

    fn place_of(handle: u64) -> u64 {
        handle & ((1 << PLACE) - 1)
    }

    #[test]
    fn invalid_handles_are_refused_with_their_reason() {
        let table = table();
        let handle = table.insert("one").unwrap();
        let next_generation = handle + (1 << (PLACE + KIND + PROCESS));
        let wrong = [
            (0, Unknown::Null),
            (1, Unknown::OtherKind(0)),
            (u64::MAX, Unknown::OtherKind(15)),
            (handle ^ (1 << PLACE), Unknown::OtherKind(2)),
            (handle ^ (1 << (PLACE + KIND)), Unknown::Foreign(Process(6))),
            (handle + 1, Unknown::Gone),
            (handle | ((1 << PLACE) - 1), Unknown::Gone),
            (next_generation, Unknown::Gone),
        ];
        for (wrong, why) in wrong {
            assert_eq!(table.get(wrong).unwrap_err(), why, "{wrong:#x}");
            assert_eq!(table.visit(wrong, |_| ()).unwrap_err(), why, "{wrong:#x}");
            assert_eq!(table.remove(wrong).unwrap_err(), why, "{wrong:#x}");
        }
        assert_eq!(table.visit(handle, |object| *object), Ok("one"));
        assert_eq!(*table.remove(handle).unwrap(), "one");
        assert_eq!(table.remove(handle).unwrap_err(), Unknown::Gone, "destroyed twice");
        let next = table.insert("two").unwrap();
        assert_eq!(place_of(next), place_of(handle), "the place is used again");
        assert!(table.get(handle).is_err(), "and the old handle does not name the new object");
        assert_eq!(*table.get(next).unwrap(), "two");
    }

    #[test]
    fn a_place_without_generations_left_is_left_alone() {
        let table = table();
        let handle = table.insert(()).unwrap();
        let (place, _) = table.place(handle).unwrap();
        place.0.write().unwrap().generation = GENERATIONS;
        let low = handle & ((1 << (PLACE + KIND + PROCESS)) - 1);
        let last = u64::from(GENERATIONS) << (PLACE + KIND + PROCESS) | low;
        assert!(table.remove(last).is_ok());
        assert!(table.get(last).is_err());
        assert_eq!(place_of(table.insert(()).unwrap()), 1);
    }

    #[test]
    fn every_place_is_in_one_block() {
        let mut expected = (0..BLOCKS).flat_map(|b| (0..FIRST << b).map(move |i| (b, i)));
        for index in 0..FIRST * ((1 << BLOCKS) - 1) {
            assert_eq!(Some(split(index)), expected.next());
        }
        assert_eq!(expected.next(), None);
    }

    #[test]
    fn an_object_ends_when_the_last_call_that_uses_it_does() {
        let table = table();
        let object = Arc::new(());
        let handle = table.insert(Arc::clone(&object)).unwrap();
        let call = table.get(handle).unwrap();
        drop(table.remove(handle));
        assert_eq!(Arc::strong_count(&object), 2);
        drop(call);
        assert_eq!(Arc::strong_count(&object), 1);
    }

    #[test]
    fn threads_creating_and_destroying_handles_get_their_own_objects() {
        static REMOVED: AtomicUsize = AtomicUsize::new(0);
        let table = table();
        let remove =
            |handle| REMOVED.fetch_add(usize::from(table.remove(handle).is_ok()), Ordering::SeqCst);
        let work = |thread: usize| {
            for round in 0..3000 {
                let handle = table.insert((thread, round)).unwrap();
                assert_eq!(*table.get(handle).unwrap(), (thread, round));
                // In some rounds two threads destroy the handle at once: one of them succeeds.
                thread::scope(|scope| {
                    if round % 300 == 0 {
                        scope.spawn(|| remove(handle));
                    }
                    remove(handle);
                });
                assert!(table.get(handle).is_err());
            }
        };
        let work = &work;
        thread::scope(|scope| (0..4).for_each(|thread| drop(scope.spawn(move || work(thread)))));
        assert_eq!(REMOVED.load(Ordering::SeqCst), 4 * 3000);
    }

    proptest! {
        #[test]
        fn it_is_a_map_from_handles_that_never_come_back(
            steps in prop::collection::vec(any::<(bool, u8)>(), 1..200),
        ) {
            let table = table();
            let mut model: HashMap<u64, usize> = HashMap::new();
            let mut ever = Vec::new();
            for (number, (create, which)) in steps.into_iter().enumerate() {
                if create || ever.is_empty() {
                    let handle = table.insert(number).unwrap();
                    prop_assert!(!ever.contains(&handle));
                    ever.push(handle);
                    model.insert(handle, number);
                } else {
                    let handle = ever[usize::from(which) % ever.len()];
                    let removed = table.remove(handle).ok().map(|object| *object);
                    prop_assert_eq!(removed, model.remove(&handle));
                }
                for handle in &ever {
                    let found = table.get(*handle).ok().map(|object| *object);
                    prop_assert_eq!(found, model.get(handle).copied());
                }
            }
        }
    }
}
