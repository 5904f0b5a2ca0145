//! The parties that rules name: other hosts, and other users of this host.

use std::{fmt, net::IpAddr};

use super::pattern::segment_fits;

/// Another host or another user, as rules identify it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Principal<'a> {
    /// A host that proved this name: the name of its pin, or its SAE ID.
    Name(&'a str),
    /// A host whose certificate has this name. Upper and lower case are the same.
    Certificate(&'a str),
    /// A host that proved no name, at this address.
    Address(IpAddr),
    /// A user of this host other than the daemon's.
    User(u32),
}

impl fmt::Display for Principal<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Name(name) | Self::Certificate(name) => f.write_str(name),
            Self::Address(address) => write!(f, "address:{address}"),
            Self::User(uid) => write!(f, "uid:{uid}"),
        }
    }
}

impl<'a> Principal<'a> {
    /// Parses a party as rules name it: `uid:1001`, `address:10.0.0.7`, or a name.
    ///
    /// # Errors
    /// The text is none of them. The error describes the accepted text.
    pub fn parse(text: &'a str) -> Result<Self, &'static str> {
        match (text.strip_prefix("uid:"), text.strip_prefix("address:")) {
            (Some(uid), _) => uid.parse().map(Self::User).map_err(|_| "uid: and a number"),
            (_, Some(ip)) => ip.parse().map(Self::Address).map_err(|_| "address: and an address"),
            _ if text.is_empty() => Err("a name"),
            _ if text.contains('*') => Err("one name, without *"),
            _ if is_keyword_in_disguise(text) => Err(KEYWORDS),
            _ if text == "local" => Err("uid: and a number, for a user of this host"),
            _ => Ok(Self::Name(text)),
        }
    }
}

/// One entry of `peer`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum PartyPattern {
    /// `*`: every host and every other user.
    All,
    /// `local`: every other user of this host.
    Users,
    /// `uid:1001`.
    User(u32),
    /// `address:10.0.0.*`.
    Address(String),
    /// A name, in which `*` stands for any characters.
    Name(String),
}

impl PartyPattern {
    /// Parses an entry of `peer`.
    ///
    /// # Errors
    /// The accepted entries.
    pub(super) fn parse(text: &str) -> Result<Self, &'static str> {
        if text.is_empty() || text.len() > 255 || text.trim() != text {
            return Err(
                "a name of 1 to 255 bytes without outer spaces, in which * stands for any \
                        characters, or local, or uid: and a number, or address: and an address",
            );
        }
        if is_keyword_in_disguise(text) {
            return Err(KEYWORDS);
        }
        Ok(match (text, text.strip_prefix("uid:"), text.strip_prefix("address:")) {
            ("*", ..) => Self::All,
            ("local", ..) => Self::Users,
            (_, Some(uid), _) => Self::User(uid.parse().map_err(|_| "uid: and a number")?),
            (_, _, Some(address)) => Self::Address(address_pattern(address)?),
            _ => Self::Name(text.to_owned()),
        })
    }

    /// Returns the proven name or the address that the entry names, or `None` for all other entries. A security mode
    /// knows hosts by only one of the two.
    pub(super) fn host(&self) -> Option<HostPattern<'_>> {
        match self {
            Self::Name(name) => Some(HostPattern::Name(name)),
            Self::Address(address) => Some(HostPattern::Address(address)),
            _ => None,
        }
    }

    pub(super) fn fits(&self, party: Principal<'_>) -> bool {
        match (self, party) {
            (Self::All, _) | (Self::Users, Principal::User(_)) => true,
            (Self::User(own), Principal::User(uid)) => *own == uid,
            (Self::Address(pattern), Principal::Address(ip)) => {
                segment_fits(pattern, &ip.to_canonical().to_string())
            }
            (Self::Name(pattern), Principal::Name(name)) => segment_fits(pattern, name),
            (Self::Name(pattern), Principal::Certificate(name)) => {
                segment_fits(&pattern.to_ascii_lowercase(), &name.to_ascii_lowercase())
            }
            _ => false,
        }
    }
}

const KEYWORDS: &str = "local, uid: and address: in lower case";

/// Returns whether a text is a keyword except for its case. Rules would read it as a host's name.
fn is_keyword_in_disguise(text: &str) -> bool {
    let lower = text.to_ascii_lowercase();
    let begins = |keyword| lower.starts_with(keyword) && !text.starts_with(keyword);
    begins("uid:") || begins("address:") || lower == "local" && text != "local"
}

/// The property by which a rule identifies a host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum HostPattern<'a> {
    /// The name that the host proves.
    Name(&'a str),
    /// The address of a host that proves no name.
    Address(&'a str),
}

/// Returns an address in canonical form, or a pattern of addresses in which `*` stands for any characters.
fn address_pattern(text: &str) -> Result<String, &'static str> {
    const ACCEPTED: &str = "address: and an address, in which * stands for any characters";
    let is_part = |c: char| c.is_ascii_hexdigit() || ".:*".contains(c);
    match text.parse::<IpAddr>() {
        Ok(address) => Ok(address.to_canonical().to_string()),
        Err(_) if text.contains('*') && text.chars().all(is_part) => Ok(text.to_ascii_lowercase()),
        Err(_) => Err(ACCEPTED),
    }
}
