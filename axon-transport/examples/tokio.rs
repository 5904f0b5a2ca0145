//! A service, its clients and a topic in tasks of tokio, in one process and without a daemon. Any other runtime will
//! do: nothing of AXON depends on one.
//!
//! ```sh
//! cargo run -p axon-transport --example tokio
//! ```
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

use std::{error::Error, sync::Arc, time::Duration};

use axon_transport::{
    EndpointSpec, Server, Session, SessionOptions,
    config::{Config, DaemonPolicy},
    qos::Qos,
};
use tokio::time::timeout;

type Result<T> = std::result::Result<T, Box<dyn Error + Send + Sync>>;

const PATIENCE: Duration = Duration::from_secs(10);

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<()> {
    let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
    let session = Session::open(&config, SessionOptions::new("example"))?;
    let spec = |name| EndpointSpec::new(name, "example/Text", Qos::keep_all());
    let server = session.create_server(spec("/capitals"))?;
    let client = Arc::new(session.create_client(spec("/capitals"))?);
    let subscription = session.create_subscription(spec("/words"))?;
    let publisher = session.create_publisher(spec("/words"))?;
    // To be matched takes no longer than these calls, which block: a program that serves others meanwhile makes
    // its endpoints before it does.
    if !client.wait_available(PATIENCE) || !publisher.wait_matched(1, PATIENCE) {
        return Err("they do not meet".into());
    }
    let serving = tokio::spawn(serve(server));

    // A topic as a stream. With the crate futures, `StreamExt` has more for it than `next`.
    for word in ["post", "quantum"] {
        publisher.publish(word.as_bytes())?;
    }
    let mut words = subscription.stream();
    let mut calls = Vec::new();
    for _ in 0..2 {
        // A timeout is the runtime's. A future that is dropped takes no sample with it.
        let (_info, word) = timeout(PATIENCE, words.next()).await?.ok_or("it has ended")??;
        // Both calls are under way at the same time.
        let client = Arc::clone(&client);
        calls.push(tokio::spawn(async move { client.call(&word).await }));
    }
    for call in calls {
        println!("{}", String::from_utf8(timeout(PATIENCE, call).await???)?);
    }
    serving.abort();
    Ok(())
}

/// Answers each request with its text in capitals.
async fn serve(server: Server) -> Result<()> {
    loop {
        let (request, text) = server.recv_request_async().await?;
        let capitals = text.to_ascii_uppercase();
        server.send_response(request.publisher, request.sequence, &capitals)?;
    }
}
