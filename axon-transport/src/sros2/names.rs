//! What ROS 2 calls its topics and services in DDS.

use crate::graph::EndpointKind;

/// What a participant of DDS does with a topic of DDS.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Does {
    /// It writes.
    Publish,
    /// It reads.
    Subscribe,
}

impl Does {
    /// As a verb before a topic.
    pub const fn verb(self) -> &'static str {
        match self {
            Self::Publish => "publish",
            Self::Subscribe => "subscribe to",
        }
    }
}

/// What a topic of DDS carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// The samples of a topic.
    Topic,
    /// The requests of a service.
    Request,
    /// Its responses.
    Reply,
}

impl Part {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Topic, Self::Request, Self::Reply];

    /// What stands before the name and behind it. The name begins with a slash.
    pub const fn mangling(self) -> (&'static str, &'static str) {
        match self {
            Self::Topic => ("rt", ""),
            Self::Request => ("rq", "Request"),
            Self::Reply => ("rr", "Reply"),
        }
    }

    /// The topic of DDS. A name without a slash in front is one that avoids ROS's conventions, and gets no prefix.
    pub fn dds_name(self, name: &str) -> String {
        let (prefix, suffix) = self.mangling();
        let prefix = if name.starts_with('/') { prefix } else { "" };
        format!("{prefix}{name}{suffix}")
    }
}

/// What the participant of an endpoint does: each of these with that topic of DDS.
pub const fn uses(kind: EndpointKind) -> &'static [(Does, Part)] {
    match kind {
        EndpointKind::Publisher => &[(Does::Publish, Part::Topic)],
        EndpointKind::Subscription => &[(Does::Subscribe, Part::Topic)],
        EndpointKind::Client => &[(Does::Publish, Part::Request), (Does::Subscribe, Part::Reply)],
        EndpointKind::Server => &[(Does::Subscribe, Part::Request), (Does::Publish, Part::Reply)],
        EndpointKind::Node => &[],
    }
}
