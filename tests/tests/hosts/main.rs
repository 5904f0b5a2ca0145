//! Two hosts as real processes on loopback addresses: a daemon each, applications of their own, and
//! in qkd a KME each, simulated in the test's process.

mod access;
#[path = "../../../axon-tls/tests/common/anybody.rs"]
mod anybody;
mod churn;
mod cut;
mod delivery;
mod descriptors;
mod dhe;
mod disagree;
mod dropped;
mod election;
mod ending;
#[path = "../tls_memory/erase.rs"]
mod erase;
mod events;
#[path = "../../../axon-transport/daemon/tests/support/excerpt.rs"]
mod excerpt;
mod flooded;
mod forged;
mod graph;
mod greedy;
#[path = "../tls_memory/groups.rs"]
mod groups;
mod history;
mod hoard;
mod hostile;
mod identity;
mod kme_keys;
mod liar;
mod link_memory;
mod load;
mod lure;
mod many_topics;
mod mismatch;
mod mixed;
mod mode;
mod outage;
mod pair;
mod paths;
mod process;
mod qlog;
mod quic;
mod range;
mod recorded;
mod renewal;
mod repeated;
mod replaced;
mod restart;
mod rules;
mod seams;
mod secrets;
mod services;
mod slow;
mod squatter;
mod stranger;
mod traffic_keys;
#[path = "../tls_memory/transcript.rs"]
mod transcript;
mod unread;
mod wire;
