//! The checks of every parser that reads bytes from outside. They are separate from the fuzzer that produces the bytes,
//! so that the seeds can run on any toolchain.
//!
//! A check returns whether the parser accepted its input, and panics when a property is violated.

#![forbid(unsafe_code)]

pub mod config;
pub mod envelope;
pub mod kme;
pub mod quic;
pub mod sros2;
pub mod tls;
pub mod transport;

/// A fuzz target: its name, its check, and inputs that the check accepts.
pub struct Target {
    /// The binary's name.
    pub name: &'static str,
    /// Runs one input; whether the parser accepted it.
    pub check: fn(&[u8]) -> bool,
    /// Inputs to start from, all of them accepted.
    pub seeds: fn() -> Vec<Vec<u8>>,
}

/// All of them.
pub const TARGETS: &[Target] = &[
    Target { name: "beacon", check: transport::beacon, seeds: transport::beacon_seeds },
    Target { name: "link_frame", check: transport::link_frame, seeds: transport::link_frame_seeds },
    Target {
        name: "session_message",
        check: transport::session_message,
        seeds: transport::session_message_seeds,
    },
    Target {
        name: "connect_packet",
        check: transport::connect_packet,
        seeds: transport::connect_packet_seeds,
    },
    Target {
        name: "relay_pieces",
        check: transport::relay_pieces,
        seeds: transport::relay_pieces_seeds,
    },
    Target { name: "envelope_header", check: envelope::header, seeds: envelope::open_seeds },
    Target { name: "envelope_inner", check: envelope::inner, seeds: envelope::inner_seeds },
    Target { name: "envelope_open", check: envelope::open, seeds: envelope::open_seeds },
    Target { name: "envelope_tamper", check: envelope::tamper, seeds: envelope::tamper_seeds },
    Target { name: "psk_identity", check: tls::psk_identity, seeds: tls::psk_identity_seeds },
    Target { name: "trust_file", check: tls::trust_file, seeds: tls::trust_file_seeds },
    Target { name: "client_hello", check: tls::client_hello, seeds: tls::client_hello_seeds },
    Target { name: "server_hello", check: tls::server_hello, seeds: tls::server_hello_seeds },
    Target {
        name: "quic_handshake",
        check: quic::quic_handshake,
        seeds: quic::quic_handshake_seeds,
    },
    Target { name: "status_response", check: kme::status_response, seeds: kme::status_seeds },
    Target { name: "key_container", check: kme::key_container, seeds: kme::container_seeds },
    Target { name: "error_response", check: kme::error_response, seeds: kme::error_seeds },
    Target {
        name: "certificate_subject",
        check: kme::certificate_subject,
        seeds: kme::subject_seeds,
    },
    Target { name: "config", check: config::config, seeds: config::seeds },
    Target { name: "permissions", check: sros2::permissions, seeds: sros2::seeds },
];
