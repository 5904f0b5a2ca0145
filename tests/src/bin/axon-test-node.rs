//! An application for tests, with its settings from the environment. It ends when its standard input ends.
//!
//! `publish TOPIC SIZES READERS COUNT`: waits for READERS readers, then publishes COUNT samples. With `stream` as COUNT
//! it publishes one sample a millisecond until the first line on standard input. With `flood` it publishes as fast as
//! it may. `subscribe TOPIC SIZES`: takes and compares samples. `history` does the same, with the samples that were
//! published before. `serve SERVICE COUNT`: answers COUNT requests with their bytes reversed, and takes one more. `ask
//! SERVICE COUNT`: sends COUNT requests, and takes no response. `alive TOPIC`: a publisher that has a lease of half a
//! second, and publishes nothing. `everything NAME`: a node with one endpoint of each kind under that name.

use std::{
    error::Error,
    io::{BufReader, Read},
    sync::mpsc::{self, Receiver, TryRecvError},
    thread,
    time::{Duration, Instant},
};

use axon_shm::PublishError;
use axon_tests::{Sizes, Tally, Word, payload};
use axon_transport::{
    EndpointSpec, Session, SessionOptions,
    config::Config,
    qos::{Durability, Qos},
};

const PATIENCE: Duration = Duration::from_secs(90);
const REPORT: Duration = Duration::from_millis(50);
/// Between the samples of a stream.
const PACE: Duration = Duration::from_millis(1);

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    // The log of the test's host contains the daemon's refusals.
    let log =
        tracing_subscriber::fmt().with_max_level(tracing_subscriber::filter::LevelFilter::ERROR);
    log.with_ansi(false).with_writer(std::io::stderr).init();
    let session = Session::open(&Config::from_env()?, SessionOptions::new("test node"))?;
    let stdin = bytes_of_stdin();
    match arguments[..] {
        ["publish", topic, sizes, readers, count] => {
            let pace = if count == "stream" { PACE } else { Duration::ZERO };
            let count = count.parse().ok();
            publish(&session, &stdin, topic, sizes.parse()?, readers.parse()?, count, pace)
        }
        ["subscribe", topic, sizes] => subscribe(&session, &stdin, spec(topic), sizes.parse()?),
        ["history", topic, sizes] => {
            let qos = Qos::keep_all().with_durability(Durability::TransientLocal);
            let latched = EndpointSpec::new(topic, "test/Bytes", qos);
            subscribe(&session, &stdin, latched, sizes.parse()?)
        }
        ["serve", service, count] => serve(&session, &stdin, service, count.parse()?),
        ["ask", service, count] => ask(&session, &stdin, service, count.parse()?),
        ["alive", topic] => alive(&session, &stdin, topic),
        ["everything", name] => everything(&session, &stdin, name),
        _ => Err(
            "publish TOPIC SIZES READERS COUNT, subscribe or history TOPIC SIZES, serve or ask SERVICE COUNT, \
             alive TOPIC, everything NAME"
                .into(),
        ),
    }
}

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", Qos::keep_all())
}

fn alive(session: &Session, stdin: &Receiver<u8>, topic: &str) -> Result<(), Box<dyn Error>> {
    let qos = Qos::default().with_lease(Duration::from_millis(500));
    let _publisher = session.create_publisher(EndpointSpec::new(topic, "test/Bytes", qos))?;
    Word::Ready.say()?;
    while stdin.recv().is_ok() {}
    Ok(())
}

fn everything(session: &Session, stdin: &Receiver<u8>, name: &str) -> Result<(), Box<dyn Error>> {
    let node = session.create_node("everything", "/of/a/process", "/")?;
    let _ends = (
        node.create_publisher(spec(name))?,
        node.create_subscription(spec(name))?,
        node.create_server(spec(name))?,
        node.create_client(spec(name))?,
    );
    Word::Ready.say()?;
    while stdin.recv().is_ok() {}
    Ok(())
}

fn publish(
    session: &Session,
    stdin: &Receiver<u8>,
    topic: &str,
    sizes: Sizes,
    readers: usize,
    count: Option<u64>,
    pace: Duration,
) -> Result<(), Box<dyn Error>> {
    let publisher = session.create_publisher(spec(topic))?;
    if !publisher.wait_matched(readers, PATIENCE) {
        return Err(format!("{} of {readers} readers", publisher.matched().len()).into());
    }
    Word::Ready.say()?;
    let (mut bytes, mut sent, mut reported) = (Vec::new(), 0, Instant::now());
    while count != Some(sent) && (count.is_some() || stdin.try_recv() == Err(TryRecvError::Empty)) {
        payload(sizes, sent + 1, &mut bytes);
        loop {
            match publisher.publish(&bytes) {
                Ok(sequence) if sequence == sent + 1 => break,
                Ok(sequence) => return Err(format!("{sequence} after {sent}").into()),
                // The reader is slow: KEEP_ALL blocks the publisher.
                Err(PublishError::Blocked { .. }) => {}
                Err(error) => return Err(error.into()),
            }
        }
        sent += 1;
        if !pace.is_zero() {
            thread::sleep(pace);
        }
        if reported.elapsed() >= REPORT {
            reported = Instant::now();
            Word::Published(sent).say()?;
        }
    }
    Word::Sent(sent).say()?;
    // The process lives until the test has seen its samples arrive.
    while stdin.recv().is_ok() {}
    Ok(())
}

fn subscribe(
    session: &Session,
    stdin: &Receiver<u8>,
    spec: EndpointSpec,
    sizes: Sizes,
) -> Result<(), Box<dyn Error>> {
    let subscription = session.create_subscription(spec)?;
    Word::Ready.say()?;
    let (mut bytes, mut expected) = (Vec::new(), Vec::new());
    let (mut tally, mut told, mut reported) = (Tally::default(), Tally::default(), Instant::now());
    while stdin.try_recv() != Err(TryRecvError::Disconnected) {
        if let Ok(info) = subscription.recv(&mut bytes, Some(REPORT / 2)) {
            tally.count(sizes, info.sequence, &bytes, &mut expected);
        }
        if reported.elapsed() >= REPORT {
            reported = Instant::now();
            tally.lost = subscription.lost();
            if tally != told {
                told.clone_from(&tally);
                Word::Taken(tally.clone()).say()?;
            }
        }
    }
    Ok(())
}

fn serve(
    session: &Session,
    stdin: &Receiver<u8>,
    service: &str,
    count: u64,
) -> Result<(), Box<dyn Error>> {
    let server = session.create_server(EndpointSpec::new(service, "test/Echo", Qos::default()))?;
    Word::Ready.say()?;
    let mut bytes = Vec::new();
    for _ in 0..count {
        let request = server.recv_request(&mut bytes, Some(PATIENCE))?;
        bytes.reverse();
        server.send_response(request.publisher, request.sequence, &bytes)?;
    }
    server.recv_request(&mut bytes, Some(PATIENCE))?;
    Word::Sent(count).say()?;
    while stdin.recv().is_ok() {}
    Ok(())
}

fn ask(
    session: &Session,
    stdin: &Receiver<u8>,
    service: &str,
    count: u64,
) -> Result<(), Box<dyn Error>> {
    let client = session.create_client(EndpointSpec::new(service, "test/Echo", Qos::default()))?;
    if !client.wait_available(PATIENCE) {
        return Err("no server".into());
    }
    Word::Ready.say()?;
    for _ in 0..count {
        client.send_request(b"and never takes")?;
    }
    Word::Sent(count).say()?;
    while stdin.recv().is_ok() {}
    Ok(())
}

/// Returns the bytes of standard input. The receiver is disconnected when standard input ends.
fn bytes_of_stdin() -> Receiver<u8> {
    let (sender, receiver) = mpsc::channel();
    thread::spawn(move || {
        for byte in BufReader::new(std::io::stdin()).bytes().map_while(Result::ok) {
            let _ = sender.send(byte);
        }
    });
    receiver
}
