//! Finds out whether this process can share memory with another process: a security module or a sandbox may
//! refuse. A session maps the daemon's probe when it connects.

#![allow(unsafe_code)]

use std::{
    os::fd::{AsFd, OwnedFd},
    ptr,
};

use rustix::{
    fs::{MemfdFlags, ftruncate, memfd_create},
    io::Errno,
    mm::{MapFlags, ProtFlags, mmap, munmap},
};

use crate::error::ShmError;

const LEN: u64 = 4096;

/// Creates empty memory, with which another process finds out whether it can map memory of this one.
///
/// # Errors
/// The system cannot create it.
pub fn probe() -> Result<OwnedFd, ShmError> {
    let fd = memfd_create("axon-probe", MemfdFlags::CLOEXEC)
        .map_err(ShmError::system("creating a memfd"))?;
    ftruncate(&fd, LEN).map_err(ShmError::system(super::segment::SIZING))?;
    Ok(fd)
}

/// Returns the error if a security policy keeps this process from mapping the memory of another. Ignores other errors:
/// the code that maps segments reports them.
pub fn out_of_reach(memory: impl AsFd) -> Option<std::io::Error> {
    // SAFETY: a fresh mapping at an address of the kernel's choice aliases nothing, and nothing accesses it.
    let mapped = unsafe {
        mmap(ptr::null_mut(), LEN as usize, ProtFlags::READ, MapFlags::SHARED, memory, 0)
    };
    match mapped {
        Ok(base) => {
            // SAFETY: the mapping just made; nothing borrows it.
            let _ = unsafe { munmap(base, LEN as usize) };
            None
        }
        Err(errno @ (Errno::ACCESS | Errno::PERM | Errno::NODEV)) => Some(errno.into()),
        Err(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unreadable_memory_is_found_and_other_memory_is_readable() {
        let probe = probe().unwrap();
        assert!(out_of_reach(&probe).is_none());
        let path = format!("/proc/self/fd/{}", std::os::fd::AsRawFd::as_raw_fd(&probe));
        let unreadable = std::fs::OpenOptions::new().write(true).open(path).unwrap();
        assert_eq!(out_of_reach(&unreadable).unwrap().kind(), std::io::ErrorKind::PermissionDenied);
    }
}
