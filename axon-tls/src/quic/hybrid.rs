//! quinn's crypto traits on the released rustls.

pub(super) use rustls as tls;

#[path = "session.rs"]
mod session;

pub(super) use session::{Client, Server};

fn negotiated(conn: &tls::CommonState) -> Option<crate::Negotiated> {
    crate::hybrid::negotiated(conn)
}
