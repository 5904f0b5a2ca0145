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

/// The daemon's end of the start-up pipe. In the foreground there is none.
#[derive(Debug)]
pub(super) struct Report {
    pipe: Option<OwnedFd>,
}

impl Report {
    /// Nobody waits.
    pub(super) fn none() -> Self {
        Self { pipe: None }
    }

    /// Takes standard output, which goes to the null device from now on.
    ///
    /// # Errors
    /// What the system says.
    pub(super) fn from_stdout() -> std::io::Result<Self> {
        let pipe = rustix::stdio::stdout().try_clone_to_owned()?;
        let null = std::fs::OpenOptions::new().write(true).open("/dev/null")?;
        rustix::stdio::dup2_stdout(null.as_fd())?;
        Ok(Self { pipe: Some(pipe) })
    }

    /// The daemon takes sessions.
    pub(super) fn ready(&mut self) {
        self.say("ready\n");
    }

    /// Another daemon has the address.
    pub(super) fn taken(&mut self) {
        self.say("taken\n");
    }

    /// The daemon gives up.
    pub(super) fn error(&mut self, text: &str) {
        self.say(&format!("error: {}\n", text.replace('\n', " ")));
    }

    fn say(&mut self, text: &str) {
        if let Some(pipe) = self.pipe.take() {
            // The process that started this one may have gone meanwhile.
            let _ = std::fs::File::from(pipe).write_all(text.as_bytes());
        }
    }
}

/// The first process: starts the second one with the same arguments, and is done.
///
/// # Errors
/// When it cannot be started.
pub(super) fn start_detached() -> std::io::Result<()> {
    let arguments = std::env::args_os().skip(1).filter(|argument| argument != SPAWNED);
    // The handle is dropped: when this process ends, the daemon's parent is the system.
    Command::new(std::env::current_exe()?).args(arguments).arg(DETACHED).spawn().map(drop)
}

/// The second process: leaves the session's terminal, directory and descriptors.
///
/// # Errors
/// What the system says.
pub(super) fn detach(config: Option<&Config>) -> std::io::Result<()> {
    rustix::process::setsid()?;
    rustix::process::chdir("/")?;
    if let Some(config) = config
        && let Some(dir) = &config.runtime_dir
        && private_directory(dir).is_ok()
    {
        // Without its log a daemon works as well.
        let _ = log::keep_in(&dir.join(format!("axon-{}.log", config.domain)));
    }
    Ok(())
}
