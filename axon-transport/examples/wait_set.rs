//! One thread that waits for several things at once: samples, a request, and the wish of another thread that it
//! end. In one process, without a daemon.
//!
//! ```sh
//! cargo run -p axon-transport --example wait_set
//! ```
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

use std::{error::Error, thread, time::Duration};

use axon_transport::{
    EndpointSpec, Session, SessionOptions, Waitable,
    config::{Config, DaemonPolicy},
    qos::Qos,
};

const PATIENCE: Duration = Duration::from_secs(10);

fn main() -> Result<(), Box<dyn Error>> {
    let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
    let session = Session::open(&config, SessionOptions::new("example"))?;
    let spec = |name| EndpointSpec::new(name, "example/Text", Qos::keep_all());
    let subscription = session.create_subscription(spec("/speed"))?;
    let server = session.create_server(spec("/halt"))?;
    let stop = session.create_guard_condition();

    let publisher = session.create_publisher(spec("/speed"))?;
    let client = session.create_client(spec("/halt"))?;
    if !publisher.wait_matched(1, PATIENCE) || !client.wait_available(PATIENCE) {
        return Err("they do not meet".into());
    }
    let (asked, asks) = (stop.clone(), move || -> Result<(), Box<dyn Error + Send + Sync>> {
        publisher.publish(b"1.5 m/s")?;
        client.call_blocking(b"at once", Some(PATIENCE))?;
        Ok(())
    });
    let other = thread::spawn(move || {
        let result = asks();
        // Whatever came of it. A signal handler may trigger a guard condition, too.
        asked.trigger();
        result
    });

    let all = [
        Waitable::Subscription(&subscription),
        Waitable::Server(&server),
        Waitable::GuardCondition(&stop),
    ];
    let mut bytes = Vec::new();
    'ended: loop {
        // The indices of all that are ready. The thread sleeps until there is one.
        for &ready in session.wait_for(&all, None)?.iter() {
            match ready {
                0 => {
                    while subscription.take(&mut bytes).is_some() {
                        println!("speed: {}", String::from_utf8_lossy(&bytes));
                    }
                }
                1 => {
                    while let Some(request) = server.take_request(&mut bytes) {
                        println!("halt: {}", String::from_utf8_lossy(&bytes));
                        server.send_response(request.publisher, request.sequence, b"done")?;
                    }
                }
                _ => break 'ended,
            }
        }
    }
    other.join().expect("the other thread ends").map_err(|error| error.to_string().into())
}
