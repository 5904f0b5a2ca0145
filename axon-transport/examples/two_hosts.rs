//! A talker on one host, and a listener on another.
//!
//! ```sh
//! host-a$ AXON_DAEMON_PEERS=host-b cargo run -p axon-transport --example two_hosts talk
//! host-b$ AXON_DAEMON_PEERS=host-a cargo run -p axon-transport --example two_hosts listen
//! ```
//!
//! Where multicast reaches the other host, neither has to be named. Two shells of one machine are two hosts if each
//! sets, besides, a directory of its own in `AXON_RUNTIME_DIR`, and in `AXON_BIND_ADDRS` 127.0.0.1 or 127.0.0.2, which
//! is then what the other names.
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

use std::{env, error::Error, time::Duration};

use axon_transport::{EndpointSpec, Session, SessionOptions, config::Config, qos::Qos};

/// For daemons that start, find each other and agree on keys.
const PATIENCE: Duration = Duration::from_secs(60);
const SAMPLES: u64 = 3;

fn main() -> Result<(), Box<dyn Error>> {
    let part = env::args().nth(1).ok_or("say talk or listen")?;
    let session = Session::open(&Config::from_env()?, SessionOptions::new(&part))?;
    let topic = EndpointSpec::new("/chatter", "example/Text", Qos::keep_all());
    match part.as_str() {
        "talk" => {
            let publisher = session.create_publisher(topic)?;
            if !publisher.wait_matched(1, PATIENCE) {
                return Err("nobody listens".into());
            }
            for number in 1..=SAMPLES {
                publisher.publish(format!("hello {number}").as_bytes())?;
            }
            // Across hosts a RELIABLE sample is acknowledged once the other daemon has it.
            if !publisher.wait_acknowledged(PATIENCE) {
                return Err("the listener's host has not got all of it".into());
            }
            println!("said {SAMPLES}");
        }
        "listen" => {
            let subscription = session.create_subscription(topic)?;
            let mut text = Vec::new();
            for _ in 0..SAMPLES {
                subscription.recv(&mut text, Some(PATIENCE))?;
                println!("heard {}", String::from_utf8_lossy(&text));
            }
        }
        other => return Err(format!("{other}: say talk or listen").into()),
    }
    Ok(())
}
