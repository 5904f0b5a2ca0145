//! A camera image that is written and read where it is, without a copy. In one process, without a daemon; between
//! processes it is the same.
//!
//! ```sh
//! cargo run -p axon-transport --example loan
//! ```
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

use std::{error::Error, time::Duration};

use axon_transport::{
    EndpointSpec, Session, SessionOptions,
    config::{Config, DaemonPolicy},
    qos::Qos,
    shm::TrustPublishers,
};

const PATIENCE: Duration = Duration::from_secs(10);
const WIDTH: usize = 640;
const HEIGHT: usize = 480;

fn main() -> Result<(), Box<dyn Error>> {
    let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
    let session = Session::open(&config, SessionOptions::new("example"))?;
    let camera = EndpointSpec::new("/camera", "example/Image", Qos::default());
    let viewer = session.create_subscription(camera.clone())?;
    // SAFETY: all who publish the topic run this program, which writes to no sample that it has published; and
    // it forks no child.
    let viewer = viewer.trusting(unsafe { TrustPublishers::new() });
    let publisher = session.create_publisher(camera)?;
    if !publisher.wait_matched(1, PATIENCE) {
        return Err("the camera and its viewer do not meet".into());
    }

    // Shared memory, of which nobody knows before it is published.
    let mut image = publisher.loan(WIDTH * HEIGHT)?;
    for (y, row) in image.chunks_exact_mut(WIDTH).enumerate() {
        row.fill((y % 256) as u8);
    }
    image.publish()?;

    // The same memory. The publisher leaves it alone for as long as the slice lives.
    let (info, image) = viewer.recv_slice(Some(PATIENCE))?;
    let mean = image.iter().map(|&grey| f64::from(grey)).sum::<f64>() / image.len() as f64;
    println!("image {}: {} bytes, mean {mean:.1}", info.sequence, image.len());
    assert!(image.sample().is_borrowed(), "nothing was copied");
    Ok(())
}
