mod acceptor;
mod dialler;
mod flood;

use std::{net::IpAddr, time::Duration};

use axon_envelope::{KeyId, KmeKey};
use axon_tls::{
    Cipher,
    qkd::{self, PskIdentity, PskResolver},
};
use axon_transport::config::QkdPeers;
use proptest::prelude::*;

use super::{Acceptor, BootstrapDialler, Completion, DialDecision, DialRefusal, Lookup};
use crate::keys::{
    Clock,
    request::{Answer, FailureKind, Fetched, KmeRequest, RequestFailure},
};

fn ms(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn s(secs: u64) -> Duration {
    Duration::from_secs(secs)
}

fn id(text: &str) -> KeyId {
    KeyId::new(text).unwrap()
}

fn ip(text: &str) -> IpAddr {
    text.parse().unwrap()
}

fn listed(saes: &[&str]) -> QkdPeers {
    QkdPeers::Listed(saes.iter().map(|s| s.to_string()).collect())
}

fn failed(request: KmeRequest, kind: FailureKind) -> Answer {
    let outcome = Err(RequestFailure::new(kind, "as the test says"));
    Answer { request, took: ms(5), outcome }
}

fn key(request: KmeRequest, name: &str, byte: u8) -> Answer {
    let keys = vec![(id(name), KmeKey::from_slice(&[byte; 32]).unwrap())];
    Answer { request, took: ms(5), outcome: Ok(Fetched::Keys(keys)) }
}
