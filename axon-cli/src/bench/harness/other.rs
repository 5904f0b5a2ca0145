//! The other process of a measurement.

use std::{
    env,
    process::{Command, Stdio, exit},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
};

use super::{Channel, Result};
use crate::say::say;

/// A process that was started as the other side.
pub(crate) struct Other {
    channel: Option<Channel>,
    over: Arc<AtomicBool>,
    watch: Option<JoinHandle<()>>,
}

/// Starts this program again with `arguments`, which must make it the other side. The process ends
/// when the returned value is dropped. If it ends earlier, this process exits too, because this
/// process may be in a loop that nothing else ends.
pub(crate) fn spawn(arguments: &[&str]) -> Result<Other> {
    let (channel, theirs) = Channel::pair()?;
    let mut child =
        Command::new(env::current_exe()?).args(arguments).stdin(Stdio::from(theirs)).spawn()?;
    let over = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&over);
    let watch = thread::spawn(move || {
        let status = child.wait();
        if !seen.load(Ordering::Relaxed) {
            say(format_args!("the other process of the measurement ended early: {status:?}"));
            exit(1);
        }
    });
    Ok(Other { channel: Some(channel), over, watch: Some(watch) })
}

impl Other {
    /// Returns the socket to the other process.
    pub(crate) fn channel(&self) -> &Channel {
        self.channel.as_ref().expect("open until it is dropped")
    }
}

impl Drop for Other {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        self.channel = None;
        if let Some(watch) = self.watch.take() {
            let _ = watch.join();
        }
    }
}
