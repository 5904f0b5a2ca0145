//! The DDS names of ROS 2's topics and services.

use crate::graph::EndpointKind;

/// An operation of a DDS participant on a DDS topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum TopicUse {
    /// The participant writes.
    Publish,
    /// The participant reads.
    Subscribe,
}

impl TopicUse {
    /// Returns the verb that precedes the topic in a text.
    pub const fn verb(self) -> &'static str {
        match self {
            Self::Publish => "publish",
            Self::Subscribe => "subscribe to",
        }
    }
}

/// The kind of messages of a DDS topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum TopicPart {
    /// The samples of a topic.
    Topic,
    /// The requests of a service.
    Request,
    /// The responses of a service.
    Reply,
}

impl TopicPart {
    /// All kinds.
    pub const ALL: [Self; 3] = [Self::Topic, Self::Request, Self::Reply];

    /// Returns the prefix and the suffix of a name. The name begins with a slash.
    pub const fn mangling(self) -> (&'static str, &'static str) {
        match self {
            Self::Topic => ("rt", ""),
            Self::Request => ("rq", "Request"),
            Self::Reply => ("rr", "Reply"),
        }
    }

    /// Returns the name of the DDS topic. A name without a leading slash does not follow ROS's conventions and gets no
    /// prefix.
    pub fn dds_name(self, name: &str) -> String {
        let (prefix, suffix) = self.mangling();
        let prefix = if name.starts_with('/') { prefix } else { "" };
        format!("{prefix}{name}{suffix}")
    }
}

/// Returns the operations of an endpoint's participant, each with its DDS topic.
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
