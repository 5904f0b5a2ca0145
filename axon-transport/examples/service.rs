//! A service and its client in one process, without a daemon.
//!
//! ```sh
//! cargo run -p axon-transport --example service
//! ```
//!
//! With the default, `DaemonPolicy::Spawn`, the two may be in different processes and on different hosts.
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

use std::{error::Error, thread, time::Duration};

use axon_transport::{
    EndpointSpec, Server, Session, SessionOptions,
    config::{Config, DaemonPolicy},
    qos::Qos,
};

const PATIENCE: Duration = Duration::from_secs(10);

fn main() -> Result<(), Box<dyn Error + Send + Sync>> {
    let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
    let session = Session::open(&config, SessionOptions::new("example"))?;
    let spec = || EndpointSpec::new("/length", "example/Length", Qos::default());
    let server = session.create_server(spec())?;
    let client = session.create_client(spec())?;
    let answering = thread::spawn(move || answer(&server));

    // The two know each other.
    if !client.wait_available(PATIENCE) {
        return Err("no server answers".into());
    }
    let number = client.send_request(b"how long is this?")?;
    let mut bytes = Vec::new();
    let response = client.recv_response(&mut bytes, Some(PATIENCE))?;
    assert_eq!(response.sequence, number);
    println!("{} bytes", String::from_utf8(bytes)?);
    answering.join().expect("the server ends")
}

/// Answers one request with its length.
fn answer(server: &Server) -> Result<(), Box<dyn Error + Send + Sync>> {
    let mut bytes = Vec::new();
    let request = server.recv_request(&mut bytes, Some(PATIENCE))?;
    let length = bytes.len().to_string();
    server.send_response(request.publisher, request.sequence, length.as_bytes())?;
    Ok(())
}
