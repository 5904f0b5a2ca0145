//! Decides which endpoints match. Three components use this one rule: the daemon that pairs endpoints, the session
//! that reports the reason of a mismatch, and the gateway that carries samples between hosts.

use super::{Endpoint, EndpointKind};
use crate::qos::{Incompatible, compatible};

/// The relation of two endpoints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pairing {
    /// No relation: the names differ, or the kinds do not communicate.
    Unrelated,
    /// The writer's samples go to the reader.
    Match,
    /// A match, except for this QoS policy.
    IncompatibleQos(Incompatible),
    /// The names are equal, but the types differ.
    IncompatibleType,
}

/// Returns whether an endpoint of this kind writes. A server writes responses, a client writes requests.
pub fn writes(kind: EndpointKind) -> bool {
    matches!(kind, EndpointKind::Publisher | EndpointKind::Server | EndpointKind::Client)
}

/// Returns whether an endpoint of this kind reads. A server reads requests, a client reads responses.
pub fn reads(kind: EndpointKind) -> bool {
    matches!(kind, EndpointKind::Subscription | EndpointKind::Server | EndpointKind::Client)
}

/// Returns the relation of `writer` to `reader`. Types are equal if their names are equal, and their hashes too if
/// both are known.
pub fn pairing(writer: &Endpoint, reader: &Endpoint) -> Pairing {
    use EndpointKind::{Client, Publisher, Server, Subscription};
    let kinds = (writer.kind, reader.kind);
    let related = matches!(kinds, (Publisher, Subscription) | (Client, Server) | (Server, Client));
    if !related || writer.topic != reader.topic {
        return Pairing::Unrelated;
    }
    let hashes_differ = writer.type_hash != reader.type_hash
        && !writer.type_hash.is_empty()
        && !reader.type_hash.is_empty();
    if writer.type_name != reader.type_name || hashes_differ {
        return Pairing::IncompatibleType;
    }
    let mut offered = compatible(&writer.qos, &reader.qos);
    if reader.kind != Subscription {
        // A service matches only if both requests and responses match.
        offered = offered.and(compatible(&reader.qos, &writer.qos));
    }
    offered.map_or_else(Pairing::IncompatibleQos, |()| Pairing::Match)
}

#[cfg(test)]
mod tests {
    use EndpointKind::{Client, Node, Publisher, Server, Subscription};

    use super::*;
    use crate::{ids::Gid, qos::Qos};

    const KINDS: [EndpointKind; 5] = [Publisher, Subscription, Server, Client, Node];

    fn endpoint(kind: EndpointKind) -> Endpoint {
        let node = kind == Node;
        Endpoint {
            topic: if node { String::new() } else { "/t".into() },
            type_name: if node { String::new() } else { "T".into() },
            node: "n".into(),
            namespace: "/".into(),
            ..Endpoint::example(Gid([1; 16]), kind)
        }
    }

    #[test]
    fn only_three_pairs_of_kinds_speak_with_each_other() {
        let mut matched = Vec::new();
        for writer in KINDS {
            for reader in KINDS {
                match pairing(&endpoint(writer), &endpoint(reader)) {
                    Pairing::Match => {
                        assert!(writes(writer) && reads(reader));
                        matched.push((writer, reader));
                    }
                    other => assert_eq!(other, Pairing::Unrelated, "{writer:?} {reader:?}"),
                }
            }
        }
        assert_eq!(matched, [(Publisher, Subscription), (Server, Client), (Client, Server)]);
    }

    #[test]
    fn a_type_is_its_name_and_its_hash_where_both_know_it() {
        let hash = |bytes: &[u8]| Endpoint { type_hash: bytes.into(), ..endpoint(Publisher) };
        let reader = Endpoint { type_hash: vec![1, 2], ..endpoint(Subscription) };
        assert_eq!(pairing(&hash(&[1, 2]), &reader), Pairing::Match);
        assert_eq!(pairing(&hash(&[]), &reader), Pairing::Match);
        assert_eq!(pairing(&hash(&[1, 3]), &reader), Pairing::IncompatibleType);
        let renamed = Endpoint { type_name: "U".into(), ..hash(&[1, 2]) };
        assert_eq!(pairing(&renamed, &reader), Pairing::IncompatibleType);
        // The type does not matter if the topics differ.
        let elsewhere = Endpoint { topic: "/u".into(), ..renamed };
        assert_eq!(pairing(&elsewhere, &reader), Pairing::Unrelated);
    }

    #[test]
    fn a_policy_that_does_not_go_together_is_named() {
        let writer = Endpoint { qos: Qos::sensor_data(), ..endpoint(Publisher) };
        let verdict = pairing(&writer, &endpoint(Subscription));
        assert_eq!(verdict, Pairing::IncompatibleQos(Incompatible::Reliability));
    }

    #[test]
    fn a_service_and_a_client_match_in_both_directions_or_in_none() {
        let weak = Endpoint { qos: Qos::sensor_data(), ..endpoint(Client) };
        let reliability = Pairing::IncompatibleQos(Incompatible::Reliability);
        assert_eq!(pairing(&weak, &endpoint(Server)), reliability);
        assert_eq!(pairing(&endpoint(Server), &weak), reliability);
        let server = Endpoint { kind: Server, ..weak.clone() };
        assert_eq!(pairing(&server, &weak), Pairing::Match);
    }
}
