//! Peers that must not get in: each a real attempt against the running daemon of host B.

use std::{
    ffi::OsString,
    net::{Ipv4Addr, SocketAddr},
    path::Path,
    time::Duration,
};

use axon_transport::{
    config::{Config, OsFiles},
    gateway::{
        Refusal, RefusedBy,
        attempt::{self, Bootstrap, Tamper},
    },
};
use serde_json::Value;
use tokio::time::Instant;

use super::{
    DemoError, classical,
    hosts::{Host, HostSpec, axon},
    kmes::{self, Kmes},
    mode::Mode,
    report::Attempt,
};
use crate::log::Topic;

/// Host B.
const TARGET: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 2);

/// Where the attempts come from.
const VISITOR: &str = "127.0.0.1";

/// Time that the daemon has to record a refusal.
const RECORD: Duration = Duration::from_secs(5);

/// Attempts against one host.
pub(crate) struct Visit<'a> {
    /// The mode of the host.
    pub(crate) mode: Mode,
    /// The host.
    pub(crate) host: &'a Host,
    /// The KMEs.
    pub(crate) kmes: &'a Kmes,
    /// A directory for what an attempt keeps.
    pub(crate) dir: &'a Path,
    /// A topic to send envelopes on.
    pub(crate) topic: &'a Topic,
}

impl Visit<'_> {
    /// Makes every attempt that this mode is the target of.
    pub(crate) async fn all(&self) -> Result<Vec<Attempt>, DemoError> {
        match self.mode {
            Mode::Classic => Ok(vec![self.classical_groups().await?]),
            Mode::Session => Ok(vec![
                self.link("classic against qkd", Mode::Classic, Bootstrap::Genuine).await?,
                self.link("an unknown PSK identity", Mode::Session, Bootstrap::UnknownKeyId)
                    .await?,
                self.link("a wrong PSK", Mode::Session, Bootstrap::WrongKey).await?,
                self.link("messages10 against session", Mode::Messages10, Bootstrap::Genuine)
                    .await?,
            ]),
            Mode::Messages10 => self.envelopes().await,
        }
    }

    async fn classical_groups(&self) -> Result<Attempt, DemoError> {
        let peer = "a client with classical groups only (X25519, P-256, P-384)";
        let before = self.refusals().await?;
        let from = SocketAddr::from(([127, 0, 0, 1], 0));
        let outcome = classical::connect(&classical::CLASSICAL, from, self.target(peer).await?);
        let told = match outcome.await {
            Ok(classical::Outcome::Refused(reason)) => Some(reason),
            Ok(classical::Outcome::Connected) => None,
            Err(reason) => return Err(DemoError::Attempt { attempt: peer, reason }),
        };
        self.attempt(peer, told, &before).await
    }

    /// A dial as a daemon of `mode` makes it.
    async fn link(
        &self,
        peer: &'static str,
        mode: Mode,
        bootstrap: Bootstrap,
    ) -> Result<Attempt, DemoError> {
        let before = self.refusals().await?;
        let target = self.target(peer).await?;
        let sae = mode.is_qkd().then_some(kmes::SAE_B);
        let outcome = attempt::link(&self.visitor(peer, mode)?, target, sae, bootstrap).await;
        self.judge(peer, outcome.map(drop), &before).await
    }

    /// Envelopes over a link that is as it should be. That an honest one is taken, on a link made
    /// in the same way, shows that the others are refused for what was done to them.
    async fn envelopes(&self) -> Result<Vec<Attempt>, DemoError> {
        let reader = self.host.spawn("reader of the envelopes", &self.reader())?;
        let honest = "an honest envelope";
        self.envelope(honest, Tamper::Nothing).await?.map_err(|refusal| {
            let reason = format!("it should be taken, but {refusal}");
            DemoError::Attempt { attempt: honest, reason }
        })?;
        let mut attempts = Vec::new();
        for (peer, tamper) in
            [("a tampered envelope", Tamper::FlipBit), ("a replayed envelope", Tamper::Replay)]
        {
            let before = self.refusals().await?;
            let outcome = self.envelope(peer, tamper).await?;
            attempts.push(self.judge(peer, outcome, &before).await?);
        }
        reader.stop().await;
        Ok(attempts)
    }

    /// The daemon's answer to one envelope; an error when there is no link to send it on.
    async fn envelope(
        &self,
        peer: &'static str,
        tamper: Tamper,
    ) -> Result<Result<(), Refusal>, DemoError> {
        let target = self.target(peer).await?;
        let config = self.visitor(peer, self.mode)?;
        let link = attempt::link(&config, target, Some(kmes::SAE_B), Bootstrap::Genuine).await;
        let link = link.map_err(|refusal| {
            let reason = format!("the link before it: {refusal}");
            DemoError::Attempt { attempt: peer, reason }
        })?;
        Ok(link.send_envelope(&self.topic.name, &self.topic.type_name, tamper).await)
    }

    fn reader(&self) -> [OsString; 6] {
        let Topic { name, type_name } = self.topic;
        ["echo", name, "--type", type_name, "--qos", "keep-all"].map(Into::into)
    }

    async fn judge(
        &self,
        peer: &'static str,
        outcome: Result<(), Refusal>,
        before: &[Value],
    ) -> Result<Attempt, DemoError> {
        let told = match outcome {
            Ok(()) => None,
            Err(refusal) if refusal.by == RefusedBy::Peer => {
                Some(format!("{}: {}", refusal.name, refusal.reason))
            }
            // Then it is not the daemon that refused.
            Err(refusal) => {
                return Err(DemoError::Attempt { attempt: peer, reason: refusal.to_string() });
            }
        };
        self.attempt(peer, told, before).await
    }

    /// Refused is who was told so, and of whom the daemon's own record says so.
    async fn attempt(
        &self,
        peer: &'static str,
        told: Option<String>,
        before: &[Value],
    ) -> Result<Attempt, DemoError> {
        let recorded = match &told {
            Some(_) => self.recorded(before).await?,
            None => None,
        };
        Ok(Attempt {
            peer,
            refused: told.is_some() && recorded.is_some(),
            told: told.unwrap_or_else(|| "nothing: it was let in".to_owned()),
            recorded: Some(recorded.unwrap_or_else(|| "nothing".to_owned())),
        })
    }

    async fn recorded(&self, before: &[Value]) -> Result<Option<String>, DemoError> {
        let deadline = Instant::now() + RECORD;
        loop {
            let new = self.refusals().await?.into_iter().rfind(|entry| !before.contains(entry));
            if let Some(entry) = new {
                let text = |key: &str| entry[key].as_str().unwrap_or("?").to_owned();
                return Ok(Some(format!("{}: {}: {}", text("peer"), text("what"), text("reason"))));
            }
            if Instant::now() > deadline {
                return Ok(None);
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    async fn refusals(&self) -> Result<Vec<Value>, DemoError> {
        Ok(self.host.status().await?["refusals"].as_array().cloned().unwrap_or_default())
    }

    async fn target(&self, peer: &'static str) -> Result<SocketAddr, DemoError> {
        let status = self.host.status().await?;
        let port = status["port"].as_u64().and_then(|port| u16::try_from(port).ok());
        let none = || DemoError::Attempt {
            attempt: peer,
            reason: "the daemon has no QUIC port".to_owned(),
        };
        Ok((TARGET, port.ok_or_else(none)?).into())
    }

    /// The settings of a daemon of `mode` that host B would take as a peer.
    fn visitor(&self, peer: &'static str, mode: Mode) -> Result<Config, DemoError> {
        let spec = HostSpec {
            name: "the visitor",
            stem: "visitor",
            address: VISITOR,
            peer: "127.0.0.2",
            mode,
            identity: self.kmes.identity(kmes::SAE_VISITOR),
            peers: kmes::SAE_B.to_owned(),
        };
        let settings = spec.settings(&self.dir.join("visitor"));
        let settings = settings.into_iter().map(|(name, value)| (name.into(), value));
        Config::resolve(settings, None, &OsFiles)
            .map_err(|error| DemoError::Attempt { attempt: peer, reason: error.to_string() })
    }
}

/// A command under a variable that AXON no longer takes.
pub(crate) async fn obsolete_variable() -> Result<Attempt, DemoError> {
    let peer = "an obsolete variable";
    let settings = [("AXON_SECURITY_PROFILE".to_owned(), "classic".into())];
    let mut command = axon(&settings)?;
    command.arg("status").kill_on_drop(true);
    let output = command
        .output()
        .await
        .map_err(|e| DemoError::Attempt { attempt: peer, reason: e.to_string() })?;
    let line = String::from_utf8_lossy(&output.stderr).trim_end().to_owned();
    let refused = output.status.code() == Some(2)
        && line.lines().count() == 1
        && line.contains("AXON_SECURITY_PROFILE");
    Ok(Attempt { peer, refused, told: line, recorded: None })
}
