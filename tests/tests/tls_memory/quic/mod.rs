//! axon-tls's glue between quinn and each rustls, on configurations of the test's own.

pub(crate) mod axon;
pub(crate) mod released;

/// Retry packets, which no end here sends.
mod protection {
    pub(super) fn retry_tag(_: &[u8], _: &[u8]) -> [u8; 16] {
        unreachable!("no Retry is sent")
    }

    pub(super) fn is_valid_retry(_: &[u8], _: &[u8], _: &[u8]) -> bool {
        false
    }
}
