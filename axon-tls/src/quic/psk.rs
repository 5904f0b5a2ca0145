//! quinn's crypto on rustls-axon.

pub(super) use rustls_axon as tls;

// The two rustls have the same interface in different types, so the file is compiled once for each.
#[path = "session.rs"]
#[allow(clippy::duplicate_mod, reason = "each copy is made for another `tls`")]
mod session;

pub(super) use session::{Client, Server};

fn negotiated(conn: &tls::CommonState) -> Option<crate::Negotiated> {
    crate::psk::negotiated(conn)
}
