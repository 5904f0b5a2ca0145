//! Two hosts and the path between them, for programs that this one does not start.

use std::io::{self, stdin};

use serde_json::json;

use crate::{Result, host::Host, part::say, path::Settings, relay::Relay};

/// Says how the hosts are entered, carries their packets until the standard input ends, and says what became of them.
pub(crate) fn lend(settings: Settings, seed: u64) -> Result<()> {
    let directory = tempfile::Builder::new().prefix("axon-link-").tempdir()?;
    let host = |number| Host::start(directory.path(), number, 1, "");
    let hosts = [host(1)?, host(2)?];
    let relay = Relay::start(hosts.each_ref().map(|host| host.devices[0].clone()), settings, seed);
    let way_in = |host: &Host| -> Result<_> {
        Ok(json!({ "network": host.namespace()?, "address": host.address(), "device": "path0" }))
    };
    say(&json!({
        "hosts": [way_in(&hosts[0])?, way_in(&hosts[1])?],
        // Who is not root enters this one as well.
        "user": format!("/proc/{}/ns/user", std::process::id()),
    }))?;
    io::copy(&mut stdin().lock(), &mut io::sink())?;
    say(&relay.counters_both_ways())
}
