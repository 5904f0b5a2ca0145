//! What ROS 2 calls its topics and services in DDS.

use crate::graph::EndpointKind;

/// What a participant of DDS does with a topic of DDS.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum TopicUse {
    /// It writes.
    Publish,
    /// It reads.
    Subscribe,
}

impl TopicUse {
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
pub enum TopicPart {
    /// The samples of a topic.
    Topic,
    /// The requests of a service.
    Request,
    /// Its responses.
    Reply,
}

impl TopicPart {
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
pub const fn uses(kind: EndpointKind) -> &'static [(TopicUse, TopicPart)] {
    match kind {
        EndpointKind::Publisher => &[(TopicUse::Publish, TopicPart::Topic)],
        EndpointKind::Subscription => &[(TopicUse::Subscribe, TopicPart::Topic)],
        EndpointKind::Client => {
            &[(TopicUse::Publish, TopicPart::Request), (TopicUse::Subscribe, TopicPart::Reply)]
        }
        EndpointKind::Server => {
            &[(TopicUse::Subscribe, TopicPart::Request), (TopicUse::Publish, TopicPart::Reply)]
        }
        EndpointKind::Node => &[],
    }
}
