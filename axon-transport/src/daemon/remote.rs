//! The control plane's dealings with other hosts: discovery, and the gateway that it directs.

use std::{cell::RefCell, rc::Rc};

use super::{
    bridge::ToControl,
    control::Control,
    gateway::{GatewayEntry, Pause, Running},
};

/// The gateway of every daemon that is not told otherwise.
pub(super) const GATEWAY: Option<GatewayEntry> = None;

/// The gateway and discovery of a running daemon.
pub(super) struct Remote {
    entry: Option<GatewayEntry>,
    running: Option<Running>,
    pause: Pause,
}

impl Remote {
    /// Starts the gateway and waits until it stands.
    ///
    /// # Errors
    /// Why it does not.
    pub(super) async fn start(
        control: &Rc<RefCell<Control>>,
        entry: Option<GatewayEntry>,
    ) -> Result<Self, String> {
        let running = match entry {
            Some(entry) => {
                let mut running = Running::start(control, entry).map_err(|e| e.to_string())?;
                running.stands(control).await?;
                Some(running)
            }
            None => None,
        };
        Ok(Self { entry, running, pause: Pause::new() })
    }

    /// Passes on what the gateway and discovery say, and starts a gateway that failed again.
    pub(super) async fn run(&mut self, control: &Rc<RefCell<Control>>) {
        let Some(entry) = self.entry else { return std::future::pending().await };
        loop {
            let event = match &mut self.running {
                Some(running) => running.next().await,
                None => Err("not started".to_owned()),
            };
            match event {
                Ok(event) => self.event(control, event),
                Err(why) => {
                    tracing::error!(why, "the gateway failed; it is started again");
                    control.borrow_mut().gateway_ended(&why);
                    self.running = None;
                    self.pause.wait().await;
                    match Running::start(control, entry) {
                        Ok(running) => self.running = Some(running),
                        Err(error) => tracing::error!(%error, "the gateway has no thread"),
                    }
                }
            }
        }
    }

    fn event(&mut self, control: &Rc<RefCell<Control>>, event: ToControl) {
        control.borrow_mut().from_gateway(event);
    }

    /// Says goodbye.
    pub(super) async fn end(self) {
        if let Some(running) = self.running {
            running.end().await;
        }
    }
}
