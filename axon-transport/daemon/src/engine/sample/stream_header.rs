//! The header of a data stream, which states the content of the stream and its route.

use axon_shm::ids::Gid;

/// Length of a stream's header in bytes.
pub(in crate::engine) const HEADER: usize = 24;
/// A stream of RELIABLE samples, of requests, or of responses.
const RELIABLE: u8 = 1;
/// A stream of one BEST_EFFORT sample.
const BEST_EFFORT: u8 = 2;
/// A stream of the copy of one RELIABLE sample, request or response, over the standby link.
const COPY: u8 = 3;
/// A flag: the messages have short headers.
const SHORT_HEADERS: u8 = 1;
/// A flag: the sender waits for RECEIVED for these requests or responses, and responses are numbered by their flow.
const ACKNOWLEDGED: u8 = 2;

/// The header of a stream, which describes its content.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StreamHeader {
    /// True if it carries RELIABLE samples, requests or responses, one after the other.
    pub(crate) reliable: bool,
    /// True if it carries the copy of one such sample, request or response.
    pub(crate) copy: bool,
    /// True if its messages have short headers.
    pub(crate) short: bool,
    /// True if its requests or responses are acknowledged. For samples of a topic, SUBSCRIBE decides.
    pub(crate) acknowledged: bool,
    /// The receiver's number for the route.
    pub(crate) route: u32,
    /// The publisher, or for responses the client.
    pub(crate) of: Gid,
}

impl StreamHeader {
    /// Reads a header.
    ///
    /// # Errors
    /// The peer broke the format.
    pub(in crate::engine) fn parse(header: &[u8]) -> Result<Self, &'static str> {
        let (kind, flags, route, of) = match header {
            [kind, a, b, c, rest @ ..] if rest.len() == HEADER - 4 => {
                let (route, of) = rest.split_at(4);
                (*kind, [*a, *b, *c], route, of)
            }
            _ => return Err("a data stream with a short header"),
        };
        if !matches!(kind, RELIABLE | BEST_EFFORT | COPY) {
            return Err("a data stream of unknown kind");
        }
        if kind == COPY && flags[0] & SHORT_HEADERS != 0 {
            return Err("a copy with a short header");
        }
        if flags[0] & !(SHORT_HEADERS | ACKNOWLEDGED) != 0 || flags[1..] != [0; 2] {
            return Err("a data stream with unknown flags");
        }
        let (mut number, mut gid) = ([0; 4], [0; 16]);
        number.copy_from_slice(route);
        gid.copy_from_slice(of);
        Ok(Self {
            reliable: kind != BEST_EFFORT,
            copy: kind == COPY,
            short: flags[0] & SHORT_HEADERS != 0,
            acknowledged: flags[0] & ACKNOWLEDGED != 0,
            route: u32::from_be_bytes(number),
            of: Gid(gid),
        })
    }

    /// Creates the header of a stream of samples without flags.
    #[cfg(test)]
    pub(crate) fn plain(route: u32, of: Gid) -> Self {
        Self { reliable: true, copy: false, short: false, acknowledged: false, route, of }
    }

    /// Returns the header's bytes.
    pub(crate) fn encode(&self) -> [u8; HEADER] {
        let mut header = [0; HEADER];
        header[0] = match (self.reliable, self.copy) {
            (true, false) => RELIABLE,
            (true, true) => COPY,
            (false, _) => BEST_EFFORT,
        };
        header[1] = if self.short { SHORT_HEADERS } else { 0 };
        header[1] |= if self.acknowledged { ACKNOWLEDGED } else { 0 };
        header[4..8].copy_from_slice(&self.route.to_be_bytes());
        header[8..].copy_from_slice(&self.of.0);
        header
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header((reliable, copy): (bool, bool), short: bool, acknowledged: bool) -> [u8; HEADER] {
        StreamHeader { reliable, copy, short, acknowledged, route: 7, of: Gid([9; 16]) }.encode()
    }

    #[test]
    fn a_header_is_read_as_it_was_written() {
        for kind in [(true, false), (false, false), (true, true)] {
            for flags in 0..4 {
                let [short, acknowledged] = [1, 2].map(|flag| flags & flag != 0);
                let Ok(parsed) = StreamHeader::parse(&header(kind, short, acknowledged)) else {
                    assert!(kind.1 && short, "only a copy with a short header is refused");
                    continue;
                };
                let flags = (parsed.short, parsed.acknowledged);
                assert_eq!((parsed.reliable, parsed.copy), kind);
                assert_eq!(flags, (short, acknowledged));
                assert_eq!((parsed.route, parsed.of), (7, Gid([9; 16])));
            }
        }
    }

    #[test]
    fn a_header_that_is_not_one_is_refused() {
        let header = header((true, false), false, false);
        for (at, byte) in [(0, 0), (0, 4), (1, 4), (1, 0x81), (2, 1), (3, 0x80)] {
            let mut broken = header;
            broken[at] = byte;
            StreamHeader::parse(&broken).unwrap_err();
        }
        StreamHeader::parse(&header[..23]).unwrap_err();
    }
}
