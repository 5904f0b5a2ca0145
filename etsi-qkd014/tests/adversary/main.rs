//! The client against hostile KMEs, and against programs that use it wrongly: bytes that no KME
//! should send, settings that no program should make, and calls dropped half way.

mod cancellation;
mod http;
mod misuse;
mod server;
