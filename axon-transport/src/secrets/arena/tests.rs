// They fork.
#![allow(unsafe_code)]

use std::{io::Read, os::fd::AsRawFd};

use super::*;

fn address(key: &LockedKey) -> usize {
    key.slot.as_deref().unwrap().as_ptr().addr()
}

/// The flags of the mapping with this address, as the kernel tells them.
fn flags(address: usize) -> Vec<String> {
    let smaps = std::fs::read_to_string("/proc/self/smaps").unwrap();
    let mut within = false;
    for line in smaps.lines() {
        let range = line.split_once(' ').and_then(|(range, _)| range.split_once('-'));
        let range = range.map(|(a, b)| [a, b].map(|text| usize::from_str_radix(text, 16)));
        if let Some([Ok(start), Ok(end)]) = range {
            within = (start..end).contains(&address);
        } else if let Some(flags) = line.strip_prefix("VmFlags:").filter(|_| within) {
            return flags.split_whitespace().map(str::to_owned).collect();
        }
    }
    panic!("no mapping has {address:#x}");
}

#[test]
fn keys_are_in_locked_memory_and_erased_on_drop() {
    let keys: Vec<_> =
        (0..2000_u32).map(|at| LockedKey::copy_of(&[at as u8 | 1; 32]).unwrap()).collect();
    for (at, key) in (0_u32..).zip(&keys) {
        assert_eq!(*key.expose_secret(), [at as u8 | 1; 32]);
    }
    for key in keys.iter().step_by(500) {
        let flags = flags(address(key));
        for flag in ["lo", "dd", "wf"] {
            assert!(flags.iter().any(|f| f == flag), "{flag} is not among {flags:?}");
        }
    }
    let slots: Vec<_> = keys.iter().map(address).collect();
    drop(keys);
    // Under the lock, so that no other test's key takes one of them.
    let arena = lock(arena().unwrap());
    let is_one = |slot: &&&'static mut Slot| slots.contains(&slot.as_ptr().addr());
    assert!(arena.free.iter().filter(is_one).count() > 0);
    for slot in arena.free.iter().filter(is_one) {
        assert_eq!(**slot, [0; 32]);
    }
}

#[test]
fn a_forked_child_finds_no_key() {
    let key = LockedKey::copy_of(&[0x5a; 32]).unwrap();
    // SAFETY: the child reads mapped memory and ends, without a lock or an allocation.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let is_empty = key.slot.as_deref() == Some(&[0; 32]);
        // SAFETY: it ends the process at once.
        unsafe { libc::_exit(i32::from(!is_empty)) };
    }
    let mut status = -1;
    // SAFETY: waits for the child just made, and writes its status.
    assert_eq!(unsafe { libc::waitpid(child, &raw mut status, 0) }, child);
    assert_eq!(status, 0, "the child found the key");
    assert_eq!(*key.expose_secret(), [0x5a; 32]);
}

#[test]
fn a_forked_child_that_uses_its_parents_key_is_aborted_with_a_message() {
    let key = LockedKey::copy_of(&[0x5a; 32]).unwrap();
    let (mut said, says) = io::pipe().unwrap();
    // SAFETY: the child makes two system calls, and then what is tested: that neither locks nor
    // allocates. It ends without running anything of its parent's.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let no_core = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
        // SAFETY: reads the limit that it is given.
        unsafe { libc::setrlimit(libc::RLIMIT_CORE, &raw const no_core) };
        // SAFETY: both descriptors are open; the child is the only one with this standard error.
        unsafe { libc::dup2(says.as_raw_fd(), 2) };
        let used = std::hint::black_box(key.expose_secret())[0];
        // SAFETY: it ends the process at once.
        unsafe { libc::_exit(i32::from(used)) };
    }
    drop(says);
    let mut text = String::new();
    said.read_to_string(&mut text).unwrap();
    let mut status = -1;
    // SAFETY: waits for the child just made, and writes its status.
    assert_eq!(unsafe { libc::waitpid(child, &raw mut status, 0) }, child);
    assert!(libc::WIFSIGNALED(status), "the child went on with a key of zeros");
    assert_eq!(libc::WTERMSIG(status), libc::SIGABRT);
    assert!(text.contains("forked"), "{text:?}");
    assert_eq!(*key.expose_secret(), [0x5a; 32]);
}

#[test]
fn a_forked_childs_own_keys_are_locked_though_the_parents_list_was() {
    let key = LockedKey::copy_of(&[0x5a; 32]).unwrap();
    // Held at the fork, as another thread could hold it.
    let held = lock(arena().unwrap());
    // SAFETY: the child, one of many threads, allocates: its allocator is ready for that after a
    // fork (glibc). It ends without running anything of its parent's.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let (own, parents) = (LockedKey::copy_of(&[0x5b; 32]), address(&key));
        let is_locked = |own: LockedKey| {
            let flags = flags(address(&own));
            address(&own) != parents
                && ["lo", "dd", "wf"].iter().all(|f| flags.iter().any(|g| g == f))
        };
        // Given up in the child, its slot stays out of the child's list.
        drop(key);
        let found = own.is_ok_and(is_locked);
        // SAFETY: it ends the process at once.
        unsafe { libc::_exit(i32::from(!found)) };
    }
    drop(held);
    let mut status = -1;
    // SAFETY: waits for the child just made, and writes its status.
    assert_eq!(unsafe { libc::waitpid(child, &raw mut status, 0) }, child);
    assert_eq!(status, 0, "the child's key is not locked, or it has none");
    assert_eq!(*key.expose_secret(), [0x5a; 32]);
}
