//! The terms on which two daemons must agree before a link carries data.

use axon_shm::ids::DaemonId;
use axon_transport::config::{Config, Security};

use super::CloseCode;
use crate::wire::{SecurityTerms, link::LinkHello};

/// The protocol version of this build; it speaks no other.
pub const PROTOCOL: u8 = 1;

/// A setting in which two daemons differ.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{setting} is {ours} on the side that refuses, {theirs} on the other")]
pub struct TermMismatch {
    /// The code that closes the link.
    pub code: CloseCode,
    /// The variable or field.
    pub setting: &'static str,
    /// The value of the side that checks.
    pub ours: String,
    /// The value in the peer's HELLO.
    pub theirs: String,
}

impl LinkHello {
    /// Makes the HELLO of this daemon from `config`.
    pub fn new(config: &Config, daemon: DaemonId) -> Self {
        let SecurityTerms { mode, key_mode, kex, cipher, auth } = SecurityTerms::of(config);
        let sae = match &config.security {
            Security::Classic(_) => None,
            Security::Qkd(qkd) => Some(qkd.sae_id.clone()),
        };
        let host = rustix::system::uname().nodename().to_string_lossy().chars().take(63).collect();
        Self {
            protocol_min: PROTOCOL,
            protocol_max: PROTOCOL,
            domain: config.domain,
            daemon,
            mode,
            key_mode,
            kex,
            cipher,
            sae,
            host,
            auth,
            replaces: None,
            expects: None,
            static_peer: false,
            routes: None,
            proof: None,
            paths: (config.link.paths > 1).then_some(config.link.paths),
            beside: None,
        }
    }

    /// Returns the terms that both sides must have in common.
    fn terms(&self) -> SecurityTerms {
        SecurityTerms {
            mode: self.mode,
            key_mode: self.key_mode,
            kex: self.kex,
            cipher: self.cipher,
            auth: self.auth,
        }
    }
}

/// Checks the peer's HELLO against ours. `psk_sae` is the peer's SAE as the PSK names it; `None` in
/// classic.
///
/// # Errors
/// The first [`TermMismatch`].
pub fn check(
    ours: &LinkHello,
    theirs: &LinkHello,
    psk_sae: Option<&str>,
) -> Result<(), TermMismatch> {
    let differ = |code, setting, ours: String, theirs: String| {
        Err(TermMismatch { code, setting, ours, theirs })
    };
    if theirs.protocol_min > ours.protocol_max || theirs.protocol_max < ours.protocol_min {
        let range = |h: &LinkHello| format!("{}..={}", h.protocol_min, h.protocol_max);
        return differ(CloseCode::Protocol, "protocol version", range(ours), range(theirs));
    }
    if theirs.daemon == ours.daemon {
        let id = ours.daemon.to_string();
        return differ(CloseCode::Self_, "daemon id", id.clone(), id);
    }
    if let Some(expected) = theirs.expects.filter(|e| *e != ours.daemon) {
        return differ(
            CloseCode::Goodbye,
            "daemon id",
            ours.daemon.to_string(),
            format!("{expected} (it dialled a daemon that is gone)"),
        );
    }
    if theirs.domain != ours.domain {
        let (o, t) = (ours.domain.to_string(), theirs.domain.to_string());
        return differ(CloseCode::Domain, "ROS_DOMAIN_ID", o, t);
    }
    if let Some(difference) = ours.terms().first_difference(&theirs.terms()) {
        let code = match difference.setting {
            "AXON_SECURITY_MODE" => CloseCode::Mode,
            "AXON_QKD_KEY_MODE" => CloseCode::KeyMode,
            "AXON_QKD_KEX" => CloseCode::Kex,
            "AXON_QUIC_CIPHER" => CloseCode::Cipher,
            _ => CloseCode::Auth,
        };
        return differ(code, difference.setting, difference.ours, difference.theirs);
    }
    // In classic no peer proves an SAE, so no peer may claim one.
    if theirs.sae.as_deref() != psk_sae {
        let text = |sae: Option<&str>| sae.unwrap_or("absent").to_owned();
        let proven = format!("{} (by the PSK)", text(psk_sae));
        return differ(CloseCode::Sae, "SAE ID", proven, text(theirs.sae.as_deref()));
    }
    Ok(())
}
