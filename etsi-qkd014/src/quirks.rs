//! Deviations of KMEs that are tolerated by name.

use std::str::FromStr;

use crate::Error;

/// Deviations from the specification to tolerate, each by its name. By default there are none.
///
/// | name | tolerates |
/// | --- | --- |
/// | `any-key-id` | key_IDs that are not in UUID form: any 1 to 128 visible ASCII characters |
/// | `null-members` | `null` where an optional member is meant to be absent |
/// | `missing-status-numbers` | a status without some of its numbers, read as 0 |
/// | `size-in-bytes` | a KME that counts key sizes in bytes where the specification says bits |
/// | `any-case-members` | member names in another letter case: `key_id`, or `Keys`, as Table 11 has it where the examples have `keys` |
/// | `any-media-type` | answers not labelled `application/json` |
/// | `extra-members` | members that the specification does not list; they are ignored |
/// | `http-1.0` | answers over HTTP/1.0 |
/// | `any-extension` | vendor extensions that are not JSON objects |
///
/// ```
/// use etsi_qkd014::Quirks;
/// let quirks: Quirks = "any-key-id,null-members".parse()?;
/// assert_eq!(quirks, Quirks::ANY_KEY_ID | Quirks::NULL_MEMBERS);
/// assert!("lenient".parse::<Quirks>().is_err());
/// # Ok::<(), etsi_qkd014::Error>(())
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Quirks(u16);

impl Quirks {
    /// No quirks: the specification to the letter.
    pub const STRICT: Self = Self(0);
    /// key_IDs that are not in UUID form; several vendors number their keys.
    pub const ANY_KEY_ID: Self = Self(1);
    /// `null` for absent members, as many JSON serializers write them.
    pub const NULL_MEMBERS: Self = Self(1 << 1);
    /// Status without some of its numbers.
    pub const MISSING_STATUS_NUMBERS: Self = Self(1 << 2);
    /// Sizes in bytes, in the request and in the status.
    pub const SIZE_IN_BYTES: Self = Self(1 << 3);
    /// Member names in any letter case.
    pub const ANY_CASE_MEMBERS: Self = Self(1 << 4);
    /// Any Content-Type, or none.
    pub const ANY_MEDIA_TYPE: Self = Self(1 << 5);
    /// Unknown members.
    pub const EXTRA_MEMBERS: Self = Self(1 << 6);
    /// HTTP/1.0.
    pub const HTTP_1_0: Self = Self(1 << 7);
    /// Extensions of an answer that are not objects: a vendor's text, number or array.
    pub const ANY_EXTENSION: Self = Self(1 << 8);

    /// Every quirk with its name.
    pub const NAMES: [(&'static str, Self); 9] = [
        ("any-key-id", Self::ANY_KEY_ID),
        ("null-members", Self::NULL_MEMBERS),
        ("missing-status-numbers", Self::MISSING_STATUS_NUMBERS),
        ("size-in-bytes", Self::SIZE_IN_BYTES),
        ("any-case-members", Self::ANY_CASE_MEMBERS),
        ("any-media-type", Self::ANY_MEDIA_TYPE),
        ("extra-members", Self::EXTRA_MEMBERS),
        ("http-1.0", Self::HTTP_1_0),
        ("any-extension", Self::ANY_EXTENSION),
    ];

    /// Returns whether all of `other` are tolerated.
    #[must_use]
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }
}

impl std::ops::BitOr for Quirks {
    type Output = Self;
    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

impl FromStr for Quirks {
    type Err = Error;

    /// Parses names separated by commas; the empty text is [`Quirks::STRICT`].
    fn from_str(text: &str) -> Result<Self, Error> {
        let mut quirks = Self::STRICT;
        for name in text.split(',').map(str::trim).filter(|n| !n.is_empty()) {
            let (_, quirk) =
                Self::NAMES.iter().find(|(known, _)| *known == name).ok_or_else(|| {
                    let known: Vec<_> = Self::NAMES.iter().map(|(known, _)| *known).collect();
                    Error::Config {
                        setting: "quirks",
                        reason: format!("{name:?} is not one of {}", known.join(", ")),
                    }
                })?;
            quirks = quirks | *quirk;
        }
        Ok(quirks)
    }
}
