//! Publishes three samples and receives them, by way of the daemon of this user, which it starts if need be.
//!
//! ```sh
//! cargo install --locked --path axon-cli      # the daemon, once
//! cargo run -p axon-transport --example session
//! ```
//!
//! Publisher and subscription could be in two processes, or on two hosts: neither knows where the other is.
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

use std::{error::Error, time::Duration};

use axon_transport::{EndpointSpec, Session, SessionOptions, config::Config, qos::Qos};

const PATIENCE: Duration = Duration::from_secs(10);

fn main() -> Result<(), Box<dyn Error>> {
    // Settings are those of the environment and of axon.toml.
    let session = Session::open(&Config::from_env()?, SessionOptions::new("example"))?;
    // KEEP_ALL: no sample is passed over.
    let topic = EndpointSpec::new("/greetings", "example/Text", Qos::keep_all());
    let subscription = session.create_subscription(topic.clone())?;
    let publisher = session.create_publisher(topic)?;

    // What is published before the two know each other is for nobody.
    if !publisher.wait_matched(1, PATIENCE) {
        return Err("the subscription and the publisher do not meet".into());
    }
    for number in 1..=3 {
        publisher.publish(format!("greeting {number}").as_bytes())?;
    }
    let mut text = Vec::new();
    for _ in 1..=3 {
        // A time-out is an error that says so.
        let info = subscription.recv(&mut text, Some(PATIENCE))?;
        println!("{}: {}", info.sequence, String::from_utf8_lossy(&text));
    }
    Ok(())
}
