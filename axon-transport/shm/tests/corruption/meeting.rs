//! Where processes find each other: datagram sockets by names in a directory.

use std::{os::unix::net::UnixDatagram, path::Path, thread, time::Duration};

/// One end of the meeting `name`; `first` is the one that the other waits for.
pub(crate) fn meet(place: &Path, name: &str, first: bool) -> UnixDatagram {
    let path = |end: bool| place.join(format!("{name}.{}", u8::from(end)));
    let (own, other) = (path(first), path(!first));
    let _ = std::fs::remove_file(&own);
    let socket = UnixDatagram::bind(&own).expect("a name in the directory");
    while socket.connect(&other).is_err() {
        thread::sleep(Duration::from_millis(1));
    }
    socket
}
