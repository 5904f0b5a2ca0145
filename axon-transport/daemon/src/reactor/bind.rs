//! Binds the UDP sockets of a daemon, and keeps the key of its stateless resets.

use std::{
    io,
    net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket},
    path::Path,
};

use axon_transport::config::Config;

use crate::{discovery::quic_ports, error::EndpointError};

const SOCKET_BUFFER: usize = 8 << 20;

/// Binds the first free port of the domain on every address of `AXON_BIND_ADDRS`, or on the unspecified
/// address if it is empty.
///
/// # Errors
/// No port of the domain can be bound.
pub(crate) fn bind_daemon(
    config: &Config,
) -> Result<(u16, Vec<(SocketAddr, UdpSocket)>), EndpointError> {
    let addresses = if config.bind_addrs.is_empty() {
        vec![IpAddr::V4(Ipv4Addr::UNSPECIFIED)]
    } else {
        config.bind_addrs.clone()
    };
    let ports = quic_ports(config.domain);
    let (first, last) = (*ports.start(), *ports.end());
    bind_first(&addresses, ports).map_err(|source| {
        let list: Vec<_> = addresses.iter().map(ToString::to_string).collect();
        EndpointError::NoPort { first, last, addresses: list.join(", "), source }
    })
}

fn bind_first(
    addresses: &[IpAddr],
    ports: std::ops::RangeInclusive<u16>,
) -> io::Result<(u16, Vec<(SocketAddr, UdpSocket)>)> {
    let mut last = io::Error::from(io::ErrorKind::AddrInUse);
    for port in ports {
        match addresses.iter().map(|a| bind_one(SocketAddr::new(*a, port))).collect() {
            Ok(sockets) => return Ok((port, sockets)),
            Err(e) => last = e,
        }
    }
    Err(last)
}

fn bind_one(address: SocketAddr) -> io::Result<(SocketAddr, UdpSocket)> {
    // No SO_REUSEADDR: the port is this daemon's alone.
    let socket = UdpSocket::bind(address)?;
    socket.set_nonblocking(true)?;
    // The kernel clamps these to its limits; a smaller buffer only costs throughput.
    let _ = rustix::net::sockopt::set_socket_recv_buffer_size(&socket, SOCKET_BUFFER);
    let _ = rustix::net::sockopt::set_socket_send_buffer_size(&socket, SOCKET_BUFFER);
    Ok((address, socket))
}

/// Returns the key of stateless resets. It is kept in the runtime directory, so that the daemon that takes over after a
/// kill can at once tell the peers of its predecessor that their links are gone.
pub(crate) fn reset_key(runtime_dir: Option<&Path>, domain: u32) -> [u8; 32] {
    use std::{fs, io::Write, os::unix::fs::OpenOptionsExt};

    let Some(dir) = runtime_dir else { return rand::random() };
    let path = dir.join(format!("reset-{domain}.key"));
    if let Ok(bytes) = fs::read(&path)
        && let Ok(key) = bytes.try_into()
    {
        return key;
    }
    let key: [u8; 32] = rand::random();
    let written = fs::OpenOptions::new()
        .write(true)
        .create(true)
        .truncate(true)
        .mode(0o600)
        .open(&path)
        .and_then(|mut f| f.write_all(&key));
    if let Err(e) = written {
        tracing::warn!(path = %path.display(), error = %e,
            "the reset key cannot be kept: after a restart peers notice it after 120 s only");
    }
    key
}
