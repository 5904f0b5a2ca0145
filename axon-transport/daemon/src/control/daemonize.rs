//! The first steps of a daemon: it leaves the session that started it, and reports to that session over the start-up
//! pipe. The session's side is in `session::daemon::spawn`.

use std::{
    io::Write,
    os::fd::{AsFd, OwnedFd},
    process::Command,
};

use axon_transport::{
    config::Config,
    internal::session::daemon::{
        address::private_directory,
        spawn::{DETACHED, SPAWNED},
    },
};

use super::log;

/// The daemon's end of the start-up pipe. A daemon in the foreground has none.
#[derive(Debug)]
pub(super) struct Report {
    pipe: Option<OwnedFd>,
}

impl Report {
    /// Returns a report that no process waits for.
    pub(super) fn none() -> Self {
        Self { pipe: None }
    }

    /// Takes over standard output as the pipe; standard output goes to the null device from now on.
    ///
    /// # Errors
    /// The error of a system call.
    pub(super) fn from_stdout() -> std::io::Result<Self> {
        let pipe = rustix::stdio::stdout().try_clone_to_owned()?;
        let null = std::fs::OpenOptions::new().write(true).open("/dev/null")?;
        rustix::stdio::dup2_stdout(null.as_fd())?;
        Ok(Self { pipe: Some(pipe) })
    }

    /// Reports that the daemon accepts sessions.
    pub(super) fn ready(&mut self) {
        self.say("ready\n");
    }

    /// Reports that another daemon has the address.
    pub(super) fn taken(&mut self) {
        self.say("taken\n");
    }

    /// Reports that the daemon gives up.
    pub(super) fn error(&mut self, text: &str) {
        self.say(&format!("error: {}\n", text.replace('\n', " ")));
    }

    fn say(&mut self, text: &str) {
        if let Some(pipe) = self.pipe.take() {
            // The process that started this one may have ended meanwhile.
            let _ = std::fs::File::from(pipe).write_all(text.as_bytes());
        }
    }
}

/// Runs the first process: starts the second one with the same arguments, and is done.
///
/// # Errors
/// When it cannot be started.
pub(super) fn start_detached() -> std::io::Result<()> {
    let arguments = std::env::args_os().skip(1).filter(|argument| argument != SPAWNED);
    // The handle is dropped: when this process ends, the daemon's parent is the system.
    Command::new(std::env::current_exe()?).args(arguments).arg(DETACHED).spawn().map(drop)
}

/// Runs the second process: leaves the session's terminal, directory and descriptors.
///
/// # Errors
/// The error of a system call.
pub(super) fn detach(config: Option<&Config>) -> std::io::Result<()> {
    rustix::process::setsid()?;
    rustix::process::chdir("/")?;
    if let Some(config) = config
        && let Some(dir) = &config.runtime_dir
        && private_directory(dir).is_ok()
    {
        // A daemon also works without its log.
        let _ = log::keep_in(&dir.join(format!("axon-{}.log", config.domain)));
    }
    Ok(())
}
