//! A camera and its viewer: two processes that share memory, without a daemon.
//!
//! ```sh
//! cargo run --release -p axon-shm --example two_processes
//! ```
//!
//! The camera starts the viewer and hands it one end of a socket as its standard input. Over it the
//! two come together; the images never pass through it.
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

use std::{
    env,
    error::Error,
    io,
    os::{fd::OwnedFd, unix::net::UnixDatagram},
    process::{Command, Stdio},
    thread,
    time::Duration,
};

use axon_shm::{Context, Publisher, PublisherOptions, Subscriber, SubscriberOptions, qos::Qos};

const WIDTH: usize = 640;
const HEIGHT: usize = 480;
const IMAGES: u64 = 100;
const PATIENCE: Option<Duration> = Some(Duration::from_secs(10));

fn main() -> Result<(), Box<dyn Error>> {
    match env::args().nth(1).as_deref() {
        None => camera(),
        Some("viewer") => viewer(),
        Some(other) => Err(format!("unknown argument {other}: start it without any").into()),
    }
}

fn camera() -> Result<(), Box<dyn Error>> {
    let (ours, theirs) = UnixDatagram::pair()?;
    let mut viewer = Command::new(env::current_exe()?)
        .arg("viewer")
        .stdin(Stdio::from(OwnedFd::from(theirs)))
        .spawn()?;

    let options = PublisherOptions::new(Qos::default()).expected_len((WIDTH * HEIGHT) as u64);
    let publisher = Publisher::new(&Context::new()?, options)?;
    publisher.serve(&ours, PATIENCE)?;
    for number in 0..IMAGES {
        let mut image = publisher.loan(WIDTH * HEIGHT)?;
        // In the memory that the viewer reads.
        image.fill(number as u8);
        image.publish_now()?;
        thread::sleep(Duration::from_millis(5));
    }
    // What is no image tells the viewer that there are no more.
    publisher.publish(b"end")?;
    let seen = viewer.wait()?;
    if seen.success() { Ok(()) } else { Err(format!("the viewer ended with {seen}").into()) }
}

fn viewer() -> Result<(), Box<dyn Error>> {
    let options = SubscriberOptions::new(Qos::default());
    let mut camera = Subscriber::connect(&Context::new()?, io::stdin(), options, PATIENCE)?;
    let mut longest = Duration::ZERO;
    // `None` where the camera's process has ended, or says nothing for ten seconds.
    while let Some(image) = camera.recv(PATIENCE)? {
        if image.len() != WIDTH * HEIGHT {
            break;
        }
        // It stays as it is in the camera's memory until it is dropped; nothing is copied but this.
        let mut corners = [[0; 1]; 2];
        image.read_at(0, &mut corners[0]);
        image.read_at(image.len() - 1, &mut corners[1]);
        assert_eq!(corners[0], corners[1]);
        longest = longest.max(image.meta().source_time().elapsed().unwrap_or_default());
    }
    let (received, skipped, lost) = (camera.received(), camera.skipped(), camera.lost());
    println!("{received} received, {skipped} skipped, {lost} lost; the latest after {longest:?}");
    Ok(())
}
