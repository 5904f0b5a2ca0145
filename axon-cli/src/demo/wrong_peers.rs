//! Peers that must be refused. Each one is a real attempt against the running daemon of host B.

use std::{
    ffi::OsString,
    net::{Ipv4Addr, SocketAddr},
    path::Path,
    time::Duration,
};

use axon_daemon::internal::{
    Refusal, RefusedBy,
    attempt::{self, Bootstrap, Tamper},
};
use axon_transport::config::{Config, OsFiles};
use serde_json::Value;
use tokio::time::Instant;

use super::{
    DemoError, classical,
    hosts::{Host, HostSpec, axon},
    kmes::{Kmes, Role},
    mode::Mode,
    report::Attempt,
};
use crate::log::Topic;

/// The address of host B.
const TARGET: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 2);

/// The address from which the attempts come.
const VISITOR: &str = "127.0.0.1";

/// The time in which the daemon has to record a refusal.
const RECORD: Duration = Duration::from_secs(5);

/// The time in which a daemon has to refuse its settings.
const REFUSAL: Duration = Duration::from_secs(10);

/// An attempt, and the name of the one refusal that is correct for it: a TLS alert, or the close
/// code of a link (`docs/formats.md`, section 6). A refusal for another reason does not count.
#[derive(Clone, Copy, Debug)]
struct Wrong {
    peer: &'static str,
    refusal: &'static str,
}

const CLASSICAL_GROUPS: Wrong = Wrong {
    peer: "a client with classical groups only (X25519, P-256, P-384)",
    refusal: "TLS alert handshake_failure",
};
const CLASSIC_AGAINST_QKD: Wrong =
    Wrong { peer: "classic against qkd", refusal: "TLS alert missing_extension" };
const UNKNOWN_IDENTITY: Wrong =
    Wrong { peer: "an unknown PSK identity", refusal: "TLS alert unknown_psk_identity" };
const WRONG_PSK: Wrong = Wrong { peer: "a wrong PSK", refusal: "TLS alert decrypt_error" };
const WRONG_KEY_MODE: Wrong =
    Wrong { peer: "messages10 against session", refusal: "KEY_MODE_MISMATCH" };
const TAMPERED: Wrong = Wrong { peer: "a tampered envelope", refusal: "ENVELOPE_REFUSED" };
const REPLAYED: Wrong = Wrong { peer: "a replayed envelope", refusal: "ENVELOPE_REFUSED" };

/// Attempts against one host.
pub(crate) struct Visit<'a> {
    /// The security mode of the host.
    pub(crate) mode: Mode,
    /// The host.
    pub(crate) host: &'a Host,
    /// The KMEs.
    pub(crate) kmes: &'a Kmes,
    /// A directory for the files of an attempt.
    pub(crate) dir: &'a Path,
    /// The topic on which envelopes are sent.
    pub(crate) topic: &'a Topic,
}

impl Visit<'_> {
    /// Makes every attempt against this mode.
    pub(crate) async fn all(&self) -> Result<Vec<Attempt>, DemoError> {
        match self.mode {
            Mode::Classic => Ok(vec![self.classical_groups().await?]),
            Mode::Session => Ok(vec![
                self.link(CLASSIC_AGAINST_QKD, Mode::Classic, Bootstrap::Genuine).await?,
                self.link(UNKNOWN_IDENTITY, Mode::Session, Bootstrap::UnknownKeyId).await?,
                self.link(WRONG_PSK, Mode::Session, Bootstrap::WrongKey).await?,
                self.link(WRONG_KEY_MODE, Mode::Messages10, Bootstrap::Genuine).await?,
            ]),
            Mode::Messages10 => self.envelopes().await,
        }
    }

    async fn classical_groups(&self) -> Result<Attempt, DemoError> {
        const HANDSHAKE_FAILURE: u8 = 40;
        let wrong = CLASSICAL_GROUPS;
        let before = self.refusals().await?;
        let from = SocketAddr::from(([127, 0, 0, 1], 0));
        let target = self.target(wrong.peer).await?;
        let told = match classical::connect(&classical::CLASSICAL, from, target).await {
            Ok(classical::ClassicalAttempt::Refused { alert, reason }) => {
                Some((alert == Some(HANDSHAKE_FAILURE), reason))
            }
            Ok(classical::ClassicalAttempt::Connected) => None,
            Err(reason) => return Err(DemoError::Attempt { attempt: wrong.peer, reason }),
        };
        self.attempt(wrong, told, &before).await
    }

    /// Connects as a daemon of `mode` does.
    async fn link(
        &self,
        wrong: Wrong,
        mode: Mode,
        bootstrap: Bootstrap,
    ) -> Result<Attempt, DemoError> {
        let before = self.refusals().await?;
        let target = self.target(wrong.peer).await?;
        let sae = mode.is_qkd().then_some(self.kmes.sae(Role::B));
        let config = self.visitor(wrong.peer, mode)?;
        let outcome = attempt::link(&config, target, sae, bootstrap).await;
        self.judge(wrong, outcome.map(drop), &before).await
    }

    /// Sends envelopes over a correct link. The daemon first accepts an honest envelope on a link
    /// that is made in the same way. This shows that the other envelopes are refused because of the
    /// change made to them.
    async fn envelopes(&self) -> Result<Vec<Attempt>, DemoError> {
        let reader = self.host.spawn("reader of the envelopes", &self.reader())?;
        let honest = "an honest envelope";
        self.envelope(honest, Tamper::Nothing).await?.map_err(|refusal| {
            let reason = format!("it should be taken, but {refusal}");
            DemoError::Attempt { attempt: honest, reason }
        })?;
        let mut attempts = Vec::new();
        for (wrong, tamper) in [(TAMPERED, Tamper::FlipBit), (REPLAYED, Tamper::Replay)] {
            let before = self.refusals().await?;
            let outcome = self.envelope(wrong.peer, tamper).await?;
            attempts.push(self.judge(wrong, outcome, &before).await?);
        }
        reader.stop().await;
        Ok(attempts)
    }

    /// Returns the daemon's answer to one envelope. Returns an error if no link can be made to send
    /// it.
    async fn envelope(
        &self,
        peer: &'static str,
        tamper: Tamper,
    ) -> Result<Result<(), Refusal>, DemoError> {
        let target = self.target(peer).await?;
        let config = self.visitor(peer, self.mode)?;
        let link =
            attempt::link(&config, target, Some(self.kmes.sae(Role::B)), Bootstrap::Genuine).await;
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
        wrong: Wrong,
        outcome: Result<(), Refusal>,
        before: &[Value],
    ) -> Result<Attempt, DemoError> {
        let told = match outcome {
            Ok(()) => None,
            Err(refusal) if refusal.by == RefusedBy::Peer => {
                let reason = format!("{}: {}", refusal.name, refusal.reason);
                Some((refusal.name == wrong.refusal, reason))
            }
            // In this case the daemon did not refuse.
            Err(refusal) => {
                let reason = refusal.to_string();
                return Err(DemoError::Attempt { attempt: wrong.peer, reason });
            }
        };
        self.attempt(wrong, told, before).await
    }

    /// Judges an attempt. `told` holds whether the refusal has the right name, and its text. A peer
    /// counts as refused only if it was told so and the daemon recorded the same refusal.
    async fn attempt(
        &self,
        wrong: Wrong,
        told: Option<(bool, String)>,
        before: &[Value],
    ) -> Result<Attempt, DemoError> {
        let Some((right, told)) = told else {
            let told = "nothing: it was let in".to_owned();
            return Ok(Attempt { peer: wrong.peer, refused: false, told, recorded: None });
        };
        let recorded = self.recorded(wrong.refusal, before).await?;
        let refused = right && recorded.is_some();
        let recorded = recorded.unwrap_or_else(|| format!("no {}", wrong.refusal));
        Ok(Attempt { peer: wrong.peer, refused, told, recorded: Some(recorded) })
    }

    /// Returns the daemon's record of a refusal with this name that is not in `before`.
    async fn recorded(&self, refusal: &str, before: &[Value]) -> Result<Option<String>, DemoError> {
        let deadline = Instant::now() + RECORD;
        loop {
            let is_it = |entry: &Value| entry["what"] == refusal && !before.contains(entry);
            if let Some(entry) = self.refusals().await?.into_iter().rfind(is_it) {
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

    /// Returns the settings of a daemon of `mode` that host B would accept as a peer.
    fn visitor(&self, peer: &'static str, mode: Mode) -> Result<Config, DemoError> {
        let spec = HostSpec {
            name: "the visitor",
            stem: "visitor",
            address: VISITOR,
            peer: "127.0.0.2",
            mode,
            identity: self.kmes.identity(Role::Visitor),
            peers: self.kmes.sae(Role::B).to_owned(),
        };
        let settings = spec.settings(&self.dir.join("visitor"));
        let settings = settings.into_iter().map(|(name, value)| (name.into(), value));
        Config::resolve(settings, None, &OsFiles)
            .map_err(|error| DemoError::Attempt { attempt: peer, reason: error.to_string() })
    }
}

/// Runs a command with a variable that AXON no longer accepts.
pub(crate) async fn obsolete_variable() -> Result<Attempt, DemoError> {
    let peer = "an obsolete variable";
    let settings = [("AXON_SECURITY_PROFILE".to_owned(), "classic".into())];
    let mut command = axon(&settings)?;
    command.arg("daemon").kill_on_drop(true);
    let failed = |reason: String| DemoError::Attempt { attempt: peer, reason };
    // A daemon that accepted the variable would continue to run.
    let output = tokio::time::timeout(REFUSAL, command.output())
        .await
        .map_err(|_| failed("a daemon was started with it".to_owned()))?
        .map_err(|e| failed(e.to_string()))?;
    let line = String::from_utf8_lossy(&output.stderr).trim_end().to_owned();
    let refused = output.status.code() == Some(2)
        && line.lines().count() == 1
        && line.contains("AXON_SECURITY_PROFILE");
    Ok(Attempt { peer, refused, told: line, recorded: None })
}
