//! The keys of the peers: a file of pins, and the set of pins in use, which can be replaced.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, SystemTime};

use super::SpkiDigest;

/// A parsed trust file.
///
/// Each line has a key: a name, the key's digest and, optionally, the last day on which the key is
/// valid (UTC). A name may have two keys, for the time when a peer changes from one to the other.
/// `#` begins a comment.
///
/// ```
/// # use axon_tls::identity::TrustFile;
/// let file = TrustFile::parse("
/// ## the arm on table 2
/// arm-2  spki-sha256:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=
/// base   spki-sha256:AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA=  2030-12-31
/// ")?;
/// assert_eq!(file.names().collect::<Vec<_>>(), ["arm-2", "base"]);
/// # Ok::<(), axon_tls::identity::TrustFileError>(())
/// ```
#[derive(Clone, Debug, Default)]
pub struct TrustFile {
    pins: BTreeMap<SpkiDigest, Pin>,
}

/// A line of a trust file: a peer's name, its key, and the last day on which the key is trusted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pin {
    name: String,
    key: SpkiDigest,
    /// The last day as written, and the first moment after it.
    last: Option<(String, SystemTime)>,
}

impl Pin {
    /// Returns the name of the key's owner.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the key.
    pub fn key(&self) -> SpkiDigest {
        self.key
    }

    /// Returns the last day on which the pin is valid (UTC), as `YYYY-MM-DD`.
    pub fn last_day(&self) -> Option<&str> {
        self.last.as_ref().map(|(day, _)| day.as_str())
    }

    /// Returns whether the pin is valid at `now`.
    pub fn holds(&self, now: SystemTime) -> bool {
        self.last.as_ref().is_none_or(|(_, end)| now < *end)
    }
}

/// A line of a trust file that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("trust file, line {line}: {reason}")]
pub struct TrustFileError {
    line: usize,
    reason: &'static str,
}

impl TrustFileError {
    /// Returns the number of the line, counted from 1.
    pub fn line(&self) -> usize {
        self.line
    }

    /// Returns the reason.
    pub fn reason(&self) -> &'static str {
        self.reason
    }
}

impl TrustFile {
    /// The most keys that one name may have.
    pub const MAX_PINS_PER_NAME: usize = 2;
    /// The largest file, in bytes.
    pub const MAX_LEN: usize = 1 << 20;

    /// Parses a whole file. One unusable line makes the file unusable.
    pub fn parse(text: &str) -> Result<Self, TrustFileError> {
        if text.len() > Self::MAX_LEN {
            return Err(TrustFileError { line: 1, reason: "the file is larger than 1 MiB" });
        }
        let mut file = Self::default();
        let mut keys = HashMap::new();
        for (index, line) in text.lines().enumerate() {
            let error = |reason| TrustFileError { line: index + 1, reason };
            let Some(pin) = parse_line(line).map_err(error)? else { continue };
            let of_name: &mut usize = keys.entry(pin.name.clone()).or_default();
            *of_name += 1;
            if *of_name > Self::MAX_PINS_PER_NAME {
                return Err(error("a name can have at most two keys"));
            }
            if file.pins.insert(pin.key, pin).is_some() {
                return Err(error("this key is in the file twice"));
            }
        }
        Ok(file)
    }

    /// Returns the name that has the key, if the key is valid at `now`.
    pub fn name_of(&self, key: &SpkiDigest, now: SystemTime) -> Option<&str> {
        let pin = self.pins.get(key)?;
        pin.holds(now).then_some(pin.name.as_str())
    }

    /// Returns the pin of the key, even if it no longer [holds](Pin::holds).
    pub fn pin_of(&self, key: &SpkiDigest) -> Option<&Pin> {
        self.pins.get(key)
    }

    /// Returns every pin, grouped by name. Within a name, the pin that ends first comes first.
    pub fn pins(&self) -> impl Iterator<Item = &Pin> {
        let mut pins: Vec<_> = self.pins.values().collect();
        let end = |pin: &Pin| pin.last.as_ref().map(|(_, end)| *end);
        pins.sort_by_key(|pin| (pin.name.as_str(), end(pin).is_none(), end(pin)));
        pins.into_iter()
    }

    /// Returns every name once, in sorted order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        let mut names: Vec<_> = self.pins.values().map(|pin| pin.name.as_str()).collect();
        names.sort_unstable();
        names.dedup();
        names.into_iter()
    }

    /// Returns whether there is no key.
    pub fn is_empty(&self) -> bool {
        self.pins.is_empty()
    }
}

/// Parses a line. Returns `None` if it is empty or a comment.
fn parse_line(line: &str) -> Result<Option<Pin>, &'static str> {
    let content = line.split('#').next().unwrap_or_default();
    // Four fields are one more than a line may have. The limit bounds the work for an endless line.
    let fields: Vec<_> = content.split_ascii_whitespace().take(4).collect();
    let (name, digest, day) = match fields[..] {
        [] => return Ok(None),
        [name, digest] => (name, digest, None),
        [name, digest, day] => (name, digest, Some(day)),
        _ => return Err("expected `name spki-sha256:BASE64 [YYYY-MM-DD]`"),
    };
    if name.len() > 255 || !name.bytes().all(|byte| byte.is_ascii_graphic()) {
        return Err("a name has at most 255 printable ASCII characters");
    }
    let key =
        digest.parse().map_err(|_| "the key must be `spki-sha256:` and 44 characters of base64")?;
    let last = match day {
        Some(day) => {
            let end = end_of_day(day).ok_or("the last day must be a date YYYY-MM-DD")?;
            Some((day.to_owned(), end))
        }
        None => None,
    };
    Ok(Some(Pin { name: name.to_owned(), key, last }))
}

/// Returns the moment after the end of a day in UTC, for years 1970 to 9999.
fn end_of_day(day: &str) -> Option<SystemTime> {
    let bytes = day.as_bytes();
    if bytes.len() != 10 || bytes[4] != b'-' || bytes[7] != b'-' {
        return None;
    }
    let number = |range: std::ops::Range<usize>| -> Option<u64> {
        let digits = day.get(range)?;
        digits.bytes().all(|byte| byte.is_ascii_digit()).then(|| digits.parse().ok())?
    };
    let (year, month, date) = (number(0..4)?, number(5..7)?, number(8..10)?);

    let leap = year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400));
    let lengths = [31, if leap { 29 } else { 28 }, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31];
    let length = *lengths.get(usize::try_from(month).ok()?.checked_sub(1)?)?;
    if year < 1970 || date == 0 || date > length {
        return None;
    }
    let leap_days = |year: u64| year / 4 - year / 100 + year / 400;
    let days = (year - 1970) * 365 + leap_days(year - 1) - leap_days(1969)
        + lengths[..usize::try_from(month).ok()? - 1].iter().sum::<u64>()
        + date;
    SystemTime::UNIX_EPOCH.checked_add(Duration::from_secs(days * 86_400))
}

/// The set of pins that connections are checked against. Clones share one set.
///
/// A replaced set applies to later handshakes. The owner of existing connections has to close those
/// that are no longer trusted: [`Trust::name_of()`] identifies them.
#[derive(Clone, Debug, Default)]
pub struct Trust {
    file: Arc<RwLock<TrustFile>>,
}

impl Trust {
    /// Creates a set with the pins of `file`.
    pub fn new(file: TrustFile) -> Self {
        Self { file: Arc::new(RwLock::new(file)) }
    }

    /// Replaces the pins with those of `file`.
    pub fn replace(&self, file: TrustFile) {
        *self.file.write().unwrap_or_else(PoisonError::into_inner) = file;
    }

    /// Returns the name that has the key now.
    pub fn name_of(&self, key: &SpkiDigest) -> Option<String> {
        let file = self.file.read().unwrap_or_else(PoisonError::into_inner);
        file.name_of(key, SystemTime::now()).map(str::to_owned)
    }

    /// Returns the pin of the key, even if it no longer [holds](Pin::holds).
    pub fn pin_of(&self, key: &SpkiDigest) -> Option<Pin> {
        let file = self.file.read().unwrap_or_else(PoisonError::into_inner);
        file.pin_of(key).cloned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KEY: &str = "spki-sha256:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=";

    #[test]
    fn unusable_lines_are_refused() {
        for line in [
            "name",
            "name spki-sha256:",
            "name spki-sha256:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU",
            "name sha256:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=",
            "name spki-sha256:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuF==",
            "n\u{e4}me spki-sha256:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=",
        ] {
            assert!(TrustFile::parse(line).is_err(), "{line}");
        }
        for day in
            ["2030", "2030-13-01", "2030-00-01", "2030-02-29", "1969-12-31", "2030-1-1", "x y"]
        {
            let error = TrustFile::parse(&format!("\n a {KEY} {day}")).unwrap_err();
            assert!(error.to_string().starts_with("trust file, line 2: "), "{error}");
        }
        assert!(TrustFile::parse(&format!("a {KEY}\nb {KEY}")).is_err());
        assert!(TrustFile::parse(&"#".repeat(TrustFile::MAX_LEN + 1)).is_err());
    }

    #[test]
    fn a_name_has_two_keys_at_most() {
        let line = |byte: u8| format!("a {}\n", SpkiDigest([byte; 32]));
        assert!(TrustFile::parse(&(line(1) + &line(2))).is_ok());
        assert!(TrustFile::parse(&(line(1) + &line(2) + &line(3))).is_err());
    }

    #[test]
    fn the_largest_file_is_read_whole() {
        // The file has as many lines as fit. Each has another name.
        let line = |n: u32| {
            let mut key = [0; 32];
            key[..4].copy_from_slice(&n.to_be_bytes());
            format!("{n} {}\n", SpkiDigest(key))
        };
        let mut text = String::new();
        let mut lines = 0;
        while text.len() + 64 <= TrustFile::MAX_LEN {
            text += &line(lines);
            lines += 1;
        }
        assert!(lines > 15_000);
        let file = TrustFile::parse(&text).unwrap();
        assert_eq!(file.pins().count(), lines as usize);
        // The last line is parsed like all others: after it is cut, the error names it.
        text = line(0) + &text.replacen(&line(0), "", 1);
        assert!(TrustFile::parse(&text).is_ok());
        text.truncate(text.len() - 10);
        assert_eq!(TrustFile::parse(&text).unwrap_err().line(), lines as usize);
    }

    #[test]
    fn a_line_without_end_is_refused_by_its_first_words() {
        let text = "a ".repeat(TrustFile::MAX_LEN / 2);
        assert!(TrustFile::parse(&text).unwrap_err().reason().starts_with("expected"));
    }

    #[test]
    fn a_file_cut_anywhere_pins_nothing_that_it_does_not_say() {
        let text = format!("base {KEY} 2030-12-31\narm {} 2031-01-31\n", SpkiDigest([1; 32]));
        let whole = TrustFile::parse(&text).unwrap();
        for end in 0..text.len() {
            let Ok(part) = TrustFile::parse(&text[..end]) else { continue };
            for pin in part.pins() {
                assert!(whole.pins().any(|p| (p.name(), p.key()) == (pin.name(), pin.key())));
            }
        }
    }

    #[test]
    fn a_pin_holds_to_the_end_of_its_last_day() {
        let file = TrustFile::parse(&format!("a {KEY} 2024-02-29")).unwrap();
        let key = KEY.parse().unwrap();
        let midnight = SystemTime::UNIX_EPOCH + Duration::from_secs(1_709_251_200);
        assert_eq!(file.name_of(&key, midnight - Duration::from_nanos(1)), Some("a"));
        assert_eq!(file.name_of(&key, midnight), None);
        assert_eq!(file.name_of(&SpkiDigest([0; 32]), midnight), None);
    }

    #[test]
    fn pins_hold_the_name_key_and_last_day_of_their_lines() {
        let [one, two, three] = [1, 2, 3].map(|byte| SpkiDigest([byte; 32]));
        let text = format!("b {one}\nb {two} 2024-02-29 # old\na {three}");
        let file = TrustFile::parse(&text).unwrap();
        let pins: Vec<_> = file.pins().map(|p| (p.name(), p.key(), p.last_day())).collect();
        assert_eq!(pins, [("a", three, None), ("b", two, Some("2024-02-29")), ("b", one, None)]);
    }

    #[test]
    fn replacing_takes_a_pin_away() {
        let key = KEY.parse().unwrap();
        let trust = Trust::new(TrustFile::parse(&format!("a {KEY}")).unwrap());
        let shared = trust.clone();
        assert_eq!(shared.name_of(&key).as_deref(), Some("a"));
        trust.replace(TrustFile::default());
        assert_eq!(shared.name_of(&key), None);
    }
}
