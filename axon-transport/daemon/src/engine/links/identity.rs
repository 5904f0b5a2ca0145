//! The identity of a peer.

use std::{fmt, net::SocketAddr};

use axon_tls::identity::{Auth, SpkiDigest};

use axon_transport::access::Principal;

use super::admission::place;
use crate::link::LinkHello;

/// The text for a peer that claims the id of another one.
pub(super) const OTHERS: &str = "this daemon id is that of another host";

/// The identity that a peer proved.
#[derive(Clone, Debug)]
pub(crate) enum PeerIdentity {
    /// Proven by a KME key.
    Sae(String),
    /// Proven by a key that is pinned under this name.
    Pinned(String, SpkiDigest),
    /// Proven by a certificate for this host name.
    Host(String, SpkiDigest),
    /// Unauthenticated: the peer only proved that it has this key, if any.
    Somebody(Option<SpkiDigest>),
}

impl PeerIdentity {
    /// Returns the identity of a link's peer after its HELLO was checked. `key` is the key that the peer
    /// proved.
    ///
    /// # Errors
    /// The key is no longer pinned, or the peer proved none. Such a link is refused, because name rules would
    /// not apply to a link without a name, even after the pin returns.
    pub(crate) fn of(
        qkd: bool,
        auth: Option<&Auth>,
        hello: &LinkHello,
        key: Option<SpkiDigest>,
    ) -> Result<Self, String> {
        if let (true, Some(sae)) = (qkd, &hello.sae) {
            return Ok(Self::Sae(sae.clone()));
        }
        match (auth, key) {
            (Some(Auth::Pinned { trust, .. }), key) => {
                let name = key.and_then(|key| Some((trust.name_of(&key)?, key)));
                let gone = || "its key is no longer pinned in AXON_CLASSIC_TRUST".to_owned();
                name.map(|(name, key)| Self::Pinned(name, key)).ok_or_else(gone)
            }
            (Some(Auth::Ca(_)), Some(key)) => Ok(Self::Host(hello.host.to_ascii_lowercase(), key)),
            (Some(Auth::Ca(_)), None) => Err("it proved no key of a certificate".to_owned()),
            (_, key) => Ok(Self::Somebody(key)),
        }
    }

    /// Returns whether both identities are the same host. A name stays the same under another key. An
    /// unauthenticated peer stays the same only while its key does.
    pub(crate) fn is(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Sae(one), Self::Sae(other)) => one == other,
            (Self::Pinned(one, _), Self::Pinned(other, _)) => one == other,
            (Self::Host(one, _), Self::Host(other, _)) => one == other,
            (Self::Somebody(one), Self::Somebody(other)) => one == other,
            _ => false,
        }
    }

    /// Returns the host's name for status: the proven name, or else the name that the host `calls_itself`.
    pub(super) fn host_name(&self, calls_itself: &str) -> String {
        match self {
            // The name that the peer gives itself is not proven.
            Self::Pinned(name, _) => name.clone(),
            _ => calls_itself.to_owned(),
        }
    }

    /// Returns why a peer that proved a pinned name is no longer that peer: its key is now pinned under
    /// another name.
    pub(super) fn renamed(&self, auth: Option<&Auth>) -> Option<String> {
        let (Self::Pinned(name, key), Some(Auth::Pinned { trust, .. })) = (self, auth) else {
            return None;
        };
        let now = trust.name_of(key).filter(|now| now != name)?;
        Some(format!("its key is pinned in AXON_CLASSIC_TRUST as {now} now, not as {name}"))
    }

    /// Returns the party that access rules apply to; `address` is the address of the peer's link.
    pub(crate) fn party(&self, address: SocketAddr) -> Principal<'_> {
        match self {
            Self::Sae(name) | Self::Pinned(name, _) => Principal::Name(name),
            Self::Host(name, _) => Principal::Certificate(name),
            Self::Somebody(_) => Principal::Address(address.ip().to_canonical()),
        }
    }

    /// Returns a string that is equal for two daemons on the same host, by their proven identity. For
    /// unauthenticated peers it is the address.
    pub(crate) fn host_identity(&self, address: SocketAddr) -> String {
        match self {
            Self::Sae(sae) => format!("sae {sae}"),
            Self::Pinned(name, _) => format!("pin {name}"),
            Self::Host(name, _) => format!("host {name}"),
            Self::Somebody(_) => format!("address {}", address.ip().to_canonical()),
        }
    }

    /// Returns a string that is equal for two daemons with a common budget: daemons of one host, or
    /// unauthenticated daemons of one IPv6 network, since a host may take any address in its network.
    pub(super) fn budget(&self, address: SocketAddr) -> String {
        match self {
            Self::Somebody(_) => format!("address {}", place(address.ip())),
            _ => self.host_identity(address),
        }
    }
}

impl fmt::Display for PeerIdentity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Sae(sae) => write!(f, "SAE {sae} (KME key)"),
            Self::Pinned(name, key) => write!(f, "{name} ({key})"),
            Self::Host(name, key) => write!(f, "{name} (certificate, {key})"),
            Self::Somebody(Some(key)) => write!(f, "UNAUTHENTICATED (key {key})"),
            Self::Somebody(None) => f.write_str("UNAUTHENTICATED"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::link::samples::hello;

    #[test]
    fn a_key_whose_pin_is_gone_is_refused_and_does_not_become_an_address() {
        use axon_tls::identity::{SigningKey, Trust, TrustFile};
        let key = SpkiDigest([7; 32]);
        let pins = |text: &str| TrustFile::parse(text).unwrap();
        let trust = Trust::new(pins(&format!("arm {key}\n")));
        let auth = Auth::Pinned { key: SigningKey::generate().unwrap(), trust: trust.clone() };
        let of = |auth, key| PeerIdentity::of(false, auth, &hello(), key);
        let who = of(Some(&auth), Some(key)).unwrap();
        assert_eq!(who.party(([127, 0, 0, 1], 1).into()), Principal::Name("arm"));
        // The pin is removed between the handshake and HELLO.
        for gone in ["# nobody\n".to_owned(), format!("arm {key} 2024-02-29\n")] {
            trust.replace(pins(&gone));
            let why = of(Some(&auth), Some(key)).unwrap_err();
            assert!(why.contains("no longer pinned in AXON_CLASSIC_TRUST"), "{why}");
        }
        of(Some(&auth), None).unwrap_err();
        let none = Auth::None(SigningKey::generate().unwrap());
        assert!(matches!(of(Some(&none), Some(key)), Ok(PeerIdentity::Somebody(Some(_)))));
    }

    #[test]
    fn neighbours_that_prove_nothing_share_a_budget_and_are_two_hosts() {
        let somebody = PeerIdentity::Somebody(Some(SpkiDigest([1; 32])));
        let at = |address: &str| address.parse().unwrap();
        let same = |one: &str, other: &str| {
            let [one, other] = [one, other].map(at);
            [
                somebody.host_identity(one) == somebody.host_identity(other),
                somebody.budget(one) == somebody.budget(other),
            ]
        };
        assert_eq!(same("[2001:db8::1]:1", "[2001:db8::2]:1"), [false, true]);
        assert_eq!(same("[2001:db8::1]:1", "[2001:db8:0:1::1]:1"), [false, false]);
        assert_eq!(same("10.0.0.1:1", "10.0.0.2:1"), [false, false]);
        assert_eq!(same("10.0.0.1:1", "[::ffff:10.0.0.1]:2"), [true, true]);
        let arm = PeerIdentity::Sae("arm".into());
        assert_eq!(arm.budget(at("10.0.0.1:1")), arm.host_identity(at("10.0.0.2:1")));
        let base = PeerIdentity::Sae("base".into());
        assert_ne!(arm.budget(at("[::1]:1")), base.budget(at("[::1]:1")));
    }

    #[test]
    fn a_name_is_the_same_under_another_key_and_no_other_name_is() {
        let [one, two] = [1, 2].map(|byte| SpkiDigest([byte; 32]));
        let name = "arm".to_owned();
        let all = [
            PeerIdentity::Sae(name.clone()),
            PeerIdentity::Pinned(name.clone(), one),
            PeerIdentity::Pinned("UNAUTHENTICATED".into(), one),
            PeerIdentity::Host(name.clone(), one),
            PeerIdentity::Host("UNAUTHENTICATED".into(), one),
            PeerIdentity::Somebody(Some(one)),
            PeerIdentity::Somebody(Some(two)),
            PeerIdentity::Somebody(None),
        ];
        let here = ([127, 0, 0, 1], 1).into();
        for (i, a) in all.iter().enumerate() {
            for (j, b) in all.iter().enumerate() {
                assert_eq!(a.is(b), i == j, "{a:?} {b:?}");
                let nobodies = i >= 5 && j >= 5;
                assert_eq!(a.host_identity(here) == b.host_identity(here), i == j || nobodies);
            }
        }
        assert!(
            PeerIdentity::Pinned(name.clone(), one).is(&PeerIdentity::Pinned(name.clone(), two))
        );
        assert!(PeerIdentity::Host(name.clone(), one).is(&PeerIdentity::Host(name, two)));
    }
}
