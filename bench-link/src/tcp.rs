//! Sends the same messages over TCP, as a program without a middleware would.

use std::{
    collections::VecDeque,
    io::{BufReader, ErrorKind, Read, Write},
    net::{TcpListener, TcpStream},
    sync::{
        Arc, Condvar, Mutex, PoisonError,
        mpsc::{Receiver, TryRecvError},
    },
    thread,
    time::Duration,
};

use socket2::{Domain, SockRef, Socket, Type};

use crate::{
    Result,
    part::{STAMP, Sent, Stream, Taken, arrival, paced, say, stamp},
};

/// Maximum number of unsent bytes in the kernel, so that a newer message can replace an older one.
const UNSENT: u32 = 16 << 10;
/// Number of attempts to connect, and the timeout of each. TCP waits longer each time for an answer.
const ATTEMPTS: u32 = 8;
const ATTEMPT: Duration = Duration::from_secs(4);
/// Time between two checks of a receiver whether it must end.
const LOOK: Duration = Duration::from_millis(20);
/// Messages that a stream without a depth holds.
const MOST_WAITING: usize = 1_000;

/// Messages that wait for the socket: the newest, as many as the stream's depth.
#[derive(Default)]
struct Waiting {
    messages: Mutex<(VecDeque<Vec<u8>>, bool)>,
    changed: Condvar,
}

/// Returns the congestion controller that the kernel takes for a connection.
pub(crate) fn congestion() -> Result<String> {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, None)?;
    let name = socket.tcp_congestion()?;
    Ok(String::from_utf8_lossy(&name).trim_end_matches('\0').to_owned())
}

/// Connects. Returns `None` if the path loses too much for a connection.
fn connect(address: &str) -> Result<Option<TcpStream>> {
    let address = address.parse()?;
    for _ in 0..ATTEMPTS {
        match TcpStream::connect_timeout(&address, ATTEMPT) {
            Ok(socket) => {
                socket.set_nodelay(true)?;
                SockRef::from(&socket).set_tcp_notsent_lowat(UNSENT)?;
                return Ok(Some(socket));
            }
            Err(error) if error.kind() == ErrorKind::TimedOut => {}
            Err(error) => return Err(error.into()),
        }
    }
    Ok(None)
}

/// Sends at the stream's rate. A message that waits while the socket is full makes way for a newer one.
pub(crate) fn send(stream: &Stream, address: &str, orders: &Receiver<()>) -> Result<()> {
    let socket = connect(address)?;
    say(&())?;
    orders.recv()?;
    let waiting = Arc::new(Waiting::default());
    let of_writer = Arc::clone(&waiting);
    let writer = thread::spawn(move || {
        if let Some(socket) = socket {
            write(socket, &of_writer);
        }
    });
    let depth = stream.depth.map_or(MOST_WAITING, |depth| depth as usize);
    let mut sent = Sent::default();
    paced(stream, orders, |number| {
        let mut bytes = vec![0x5a; stream.bytes.max(STAMP)];
        stamp(&mut bytes, number);
        sent.messages = number;
        let mut messages = waiting.messages.lock().unwrap_or_else(PoisonError::into_inner);
        while stream.depth.is_none() && messages.0.len() >= depth {
            messages = waiting.changed.wait(messages).unwrap_or_else(PoisonError::into_inner);
        }
        if messages.0.len() >= depth {
            messages.0.pop_front();
        }
        messages.0.push_back(bytes);
        drop(messages);
        waiting.changed.notify_all();
        Ok(())
    })?;
    say(&sent)?;
    waiting.messages.lock().unwrap_or_else(PoisonError::into_inner).1 = true;
    waiting.changed.notify_all();
    // The waiting messages are still sent until the measuring process ends this one.
    let _ = writer.join();
    Ok(())
}

fn write(mut socket: TcpStream, waiting: &Waiting) {
    loop {
        let mut messages = waiting.messages.lock().unwrap_or_else(PoisonError::into_inner);
        let bytes = loop {
            if let Some(bytes) = messages.0.pop_front() {
                break bytes;
            }
            if messages.1 {
                return;
            }
            messages = waiting.changed.wait(messages).unwrap_or_else(PoisonError::into_inner);
        };
        drop(messages);
        waiting.changed.notify_all();
        let length = (bytes.len() as u32).to_le_bytes();
        if socket.write_all(&[&length[..], &bytes].concat()).is_err() {
            return;
        }
    }
}

/// Takes messages until the orders end.
pub(crate) fn receive(address: &str, orders: &Receiver<()>) -> Result<()> {
    let listener = TcpListener::bind(address)?;
    say(&())?;
    let taken = Arc::new(Mutex::new(Taken::default()));
    let of_reader = Arc::clone(&taken);
    thread::spawn(move || read(&listener, &of_reader));
    while !matches!(orders.try_recv(), Err(TryRecvError::Disconnected)) {
        thread::sleep(LOOK);
    }
    say(&*taken.lock().unwrap_or_else(PoisonError::into_inner))
}

fn read(listener: &TcpListener, taken: &Mutex<Taken>) -> Result<()> {
    let (socket, _) = listener.accept()?;
    let mut socket = BufReader::with_capacity(256 << 10, socket);
    let mut bytes = Vec::new();
    loop {
        let mut length = [0; 4];
        socket.read_exact(&mut length)?;
        bytes.resize(u32::from_le_bytes(length) as usize, 0);
        socket.read_exact(&mut bytes)?;
        let arrival = arrival(&bytes)?;
        taken.lock().unwrap_or_else(PoisonError::into_inner).arrivals.push(arrival);
    }
}
