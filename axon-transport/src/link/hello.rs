//! What two daemons must agree on before a link carries anything.

use axon_tls::{Cipher, PskKex};

use super::{CloseCode, message::Hello};
use crate::{
    config::{ClassicAuth, Config, KeyMode, Security},
    ids::DaemonId,
};

/// The protocol version of this build; it speaks no other.
pub const PROTOCOL: u8 = 1;

/// A setting in which two daemons differ.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{code}: {setting} here is {ours}, the peer's is {theirs}")]
pub struct Mismatch {
    /// The code that closes the link.
    pub code: CloseCode,
    /// The variable or field.
    pub setting: &'static str,
    /// The value of the side that checks.
    pub ours: String,
    /// The value in the peer's HELLO.
    pub theirs: String,
}

/// Names of the numbers in HELLO and beacon.
mod names {
    pub(super) const MODE: &[&str] = &["classic", "qkd"];
    pub(super) const KEY_MODE: &[&str] = &["none", "session", "messages10"];
    pub(super) const KEX: &[&str] = &["X25519MLKEM768", "psk_ke", "psk_dhe_ke"];
    pub(super) const CIPHER: &[&str] = &["chacha20-poly1305", "aes-256-gcm"];
    pub(super) const AUTH: &[&str] = &["none", "pinned", "ca"];
}

fn name(names: &[&str], value: u8) -> String {
    names.get(usize::from(value)).map_or_else(|| format!("unknown ({value})"), |n| (*n).into())
}

impl Hello {
    /// What `config` says of this daemon.
    pub fn new(config: &Config, daemon: DaemonId) -> Self {
        let (mode, key_mode, kex, sae, auth) = match &config.security {
            Security::Classic(c) => {
                let auth = match c.auth {
                    ClassicAuth::None => 0,
                    ClassicAuth::Pinned => 1,
                    ClassicAuth::Ca => 2,
                };
                (0, 0, 0, None, Some(auth))
            }
            Security::Qkd(q) => {
                let key_mode = match q.key_mode {
                    KeyMode::Session => 1,
                    KeyMode::Messages10 => 2,
                };
                let kex = match q.kex {
                    PskKex::PskKe => 1,
                    PskKex::PskDheKe => 2,
                };
                (1, key_mode, kex, Some(q.sae_id.clone()), None)
            }
        };
        let cipher = match config.cipher {
            Cipher::ChaCha20Poly1305 => 0,
            Cipher::Aes256Gcm => 1,
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
        }
    }
}

/// Checks the peer's HELLO against ours. `psk_sae` is the peer's SAE as the PSK names it, in qkd.
///
/// # Errors
/// The first [`Mismatch`].
pub fn check(ours: &Hello, theirs: &Hello, psk_sae: Option<&str>) -> Result<(), Mismatch> {
    let differ = |code, setting, ours: String, theirs: String| {
        Err(Mismatch { code, setting, ours, theirs })
    };
    if theirs.protocol_min > ours.protocol_max || theirs.protocol_max < ours.protocol_min {
        let range = |h: &Hello| format!("{}..={}", h.protocol_min, h.protocol_max);
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
    let numbers = [
        (CloseCode::Mode, "AXON_SECURITY_MODE", names::MODE, ours.mode, theirs.mode),
        (CloseCode::KeyMode, "AXON_QKD_KEY_MODE", names::KEY_MODE, ours.key_mode, theirs.key_mode),
        (CloseCode::Kex, "AXON_QKD_KEX", names::KEX, ours.kex, theirs.kex),
        (CloseCode::Cipher, "AXON_QUIC_CIPHER", names::CIPHER, ours.cipher, theirs.cipher),
    ];
    for (code, setting, table, o, t) in numbers {
        if o != t {
            return differ(code, setting, name(table, o), name(table, t));
        }
    }
    if ours.auth != theirs.auth {
        let text = |a: Option<u8>| a.map_or_else(|| "absent".into(), |a| name(names::AUTH, a));
        return differ(
            CloseCode::Auth,
            "AXON_CLASSIC_AUTH",
            text(ours.auth),
            text(theirs.auth),
        );
    }
    if let Some(psk_sae) = psk_sae.filter(|s| theirs.sae.as_deref() != Some(*s)) {
        let theirs = theirs.sae.clone().unwrap_or_else(|| "absent".into());
        return differ(CloseCode::Sae, "SAE ID", format!("{psk_sae} (by the PSK)"), theirs);
    }
    Ok(())
}
