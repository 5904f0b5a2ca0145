//! etsi-qkd014
