//! The endpoints of a peer that this side does not hold.

use axon_shm::ids::Gid;
use axon_transport::graph::{Endpoint, EndpointKind};

/// Endpoints that were left out since the peer sent its whole graph: the first of them, and their number.
#[derive(Debug, Default)]
pub(super) struct OmittedEndpoints {
    first: Option<FirstOmission>,
    count: u64,
}

/// An endpoint that was left out.
#[derive(Debug)]
struct FirstOmission {
    /// The endpoint's name, and the reason.
    text: String,
    /// Bytes that it would take; `None` if bytes are not what is missing.
    bytes: Option<usize>,
}

impl OmittedEndpoints {
    /// Records an endpoint for which there is no space, because the peer's graph `has` too much. `bytes` is the number
    /// of bytes that would be enough, if bytes are missing.
    pub(super) fn add_for_room(
        &mut self,
        endpoint: &Endpoint,
        bytes: Option<usize>,
        has: impl FnOnce() -> String,
    ) {
        self.add(bytes, || {
            format!("{} is left out: the peer's graph has {}", named(endpoint), has())
        });
    }

    /// Records an endpoint of a session that the peer did not prove.
    pub(super) fn add_unproven(&mut self, endpoint: &Endpoint) {
        self.add_unproven_as(&endpoint.gid, || named(endpoint));
    }

    /// Like [`add_unproven`](Self::add_unproven), for a reader that SUBSCRIBE names for a topic.
    pub(super) fn add_unproven_reader(&mut self, gid: &Gid, topic: &str) {
        self.add_unproven_as(gid, || format!("the reader of {}", short(topic)));
    }

    fn add_unproven_as(&mut self, gid: &Gid, named: impl FnOnce() -> String) {
        self.add(None, || {
            format!(
                "{} is left out: the peer did not prove that its GID {gid} is of a session of its own",
                named()
            )
        });
    }

    fn add(&mut self, bytes: Option<usize>, text: impl FnOnce() -> String) {
        self.count += 1;
        self.first.get_or_insert_with(|| FirstOmission { text: text(), bytes });
    }

    /// Returns the first endpoint, with the reason why it was left out.
    pub(super) fn first(&self) -> Option<&str> {
        self.first.as_ref().map(|first| first.text.as_str())
    }

    /// Returns the bytes that the first endpoint would take, if bytes are what is missing.
    pub(super) fn needed(&self) -> Option<usize> {
        self.first.as_ref()?.bytes
    }

    /// Returns the number of endpoints that were left out.
    pub(super) fn count(&self) -> u64 {
        self.count
    }
}

fn short(name: &str) -> String {
    format!("{:?}", name.chars().take(100).collect::<String>())
}

/// Describes an endpoint for log and status; the peer may have given it any names.
fn named(endpoint: &Endpoint) -> String {
    let what = match endpoint.kind {
        EndpointKind::Publisher => "the publisher of",
        EndpointKind::Subscription => "the subscription to",
        EndpointKind::Server => "the server of",
        EndpointKind::Client => "the client of",
        EndpointKind::Node => return format!("the node {}", short(&endpoint.node)),
    };
    format!("{what} {} in node {}", short(&endpoint.topic), short(&endpoint.node))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_endpoint_is_named_and_all_are_counted() {
        let named = |topic: &str| {
            Endpoint::new(Gid([1; 16]), EndpointKind::Server, topic, "T").with_node("n", "/")
        };
        let mut left_out = OmittedEndpoints::default();
        assert_eq!((left_out.first(), left_out.needed(), left_out.count()), (None, None, 0));
        left_out.add_for_room(&named("/a"), Some(100), || "more than 3 MiB".into());
        left_out.add_unproven(&named("/b"));
        left_out.add_unproven_reader(&Gid([2; 16]), "/c");
        let first =
            "the server of \"/a\" in node \"n\" is left out: the peer's graph has more than 3 MiB";
        assert_eq!(left_out.first(), Some(first));
        assert_eq!((left_out.needed(), left_out.count()), (Some(100), 3));
    }

    #[test]
    fn a_name_that_a_peer_made_very_long_or_unreadable_is_cut_and_escaped() {
        let mut left_out = OmittedEndpoints::default();
        left_out.add_unproven_reader(&Gid([2; 16]), &"\n".repeat(5000));
        let text = left_out.first().unwrap();
        assert!(text.len() < 400 && !text.contains('\n'), "{text}");
        assert_eq!(left_out.needed(), None, "bytes are not what is missing");
    }
}
