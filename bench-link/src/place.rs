//! The place of a measurement: two hosts and the path between them.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
    thread,
    time::Duration,
};

use tempfile::TempDir;

use crate::{
    Result,
    host::{Host, Running},
    kmes::Kmes,
    mode::Mode,
    part::{Part, Sent, Stream, Taken},
    path::Settings,
    relay::Relay,
};

/// The port on which TCP's receiver listens.
const PORT: u16 = 7400;
/// Maximum time for which sent messages may still be in flight.
const SETTLE: Duration = Duration::from_millis(1_500);

/// The transport of the messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Carrier {
    Axon,
    Tcp,
}

impl Carrier {
    pub(crate) const ALL: [Self; 2] = [Self::Axon, Self::Tcp];

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Axon => "AXON",
            Self::Tcp => "TCP",
        }
    }
}

/// The results of a stream.
#[derive(Clone, Debug)]
pub(crate) struct Outcome {
    pub(crate) sent: Sent,
    pub(crate) taken: Taken,
}

/// How two hosts are set up.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    pub(crate) mode: Mode,
    /// `[link] congestion` of both daemons.
    pub(crate) congestion: String,
    /// Further lines of `[link]`.
    pub(crate) link: &'static str,
    /// How many paths lead from one to the other.
    pub(crate) paths: u8,
    pub(crate) seed: u64,
}

/// Two hosts.
pub(crate) struct Place {
    pub(crate) hosts: [Host; 2],
    /// One for each path.
    pub(crate) relays: Vec<Relay>,
    kmes: Option<Kmes>,
    /// Where the hosts keep their files, such as the logs of their daemons.
    directory: TempDir,
}

impl Place {
    pub(crate) fn new(settings: Settings, plan: &Plan) -> Result<Self> {
        let directory = tempfile::Builder::new().prefix("axon-link-").tempdir()?;
        let link = format!("grace_s = 1\ncongestion = {:?}\n{}", plan.congestion, plan.link);
        let host = |number| Host::start(directory.path(), number, plan.paths, &link);
        let mut hosts = [host(1)?, host(2)?];
        let kmes = plan.mode.is_qkd().then(Kmes::start).transpose()?;
        for (number, host) in hosts.iter_mut().enumerate() {
            host.set(plan.mode.settings());
            if let Some(kmes) = &kmes {
                kmes.connect(number, host)?;
                host.set(kmes.settings(number));
            }
        }
        let relays = (0..usize::from(plan.paths)).zip(plan.seed..).map(|(path, seed)| {
            let devices = hosts.each_ref().map(|host| Arc::clone(&host.devices[path]));
            Relay::start(devices, settings, seed)
        });
        Ok(Self { relays: relays.collect(), hosts, kmes, directory })
    }

    /// Gives a variable this value on both hosts, for the programs that are started from now on.
    pub(crate) fn set(&mut self, name: &'static str, value: &str) {
        self.hosts.iter_mut().for_each(|host| host.set([(name, value.to_owned())]));
    }

    /// Keys that the KMEs gave so far, if there are KMEs.
    pub(crate) fn keys_drawn(&self) -> Option<u64> {
        self.kmes.as_ref().map(Kmes::keys_drawn)
    }

    /// Where the hosts keep their files.
    pub(crate) fn directory(&self) -> &Path {
        self.directory.path()
    }

    /// Ends it, and leaves the hosts' files where they are.
    pub(crate) fn keep(self) -> PathBuf {
        self.directory.keep()
    }

    /// The relay of the first path.
    pub(crate) fn relay(&self) -> &Relay {
        &self.relays[0]
    }

    /// How many lines of the daemons' logs have this text.
    pub(crate) fn log_lines(&self, text: &str) -> usize {
        self.hosts.iter().map(|host| host.log_lines(text)).sum()
    }

    /// Starts AXON's streams from the first host or the second to the other one. They are ready when this returns.
    pub(crate) fn streams_of(&self, streams: &[(usize, Stream)]) -> Result<Streams> {
        let mut running = Vec::new();
        for (from, stream) in streams {
            let there = self.hosts[1 - from].start_part(&Part::Subscribe(stream.clone()))?;
            running.push((self.hosts[*from].start_part(&Part::Publish(stream.clone()))?, there));
        }
        for (here, there) in &mut running {
            here.hear::<()>()?;
            there.hear::<()>()?;
        }
        Ok(Streams(running))
    }

    /// Starts streams from the first host to the second. They are ready when this returns.
    pub(crate) fn streams(&self, carrier: Carrier, streams: &[Stream]) -> Result<Streams> {
        if carrier == Carrier::Axon {
            let from_first = streams.iter().map(|stream| (0, stream.clone()));
            return self.streams_of(&from_first.collect::<Vec<_>>());
        }
        let mut running = Vec::new();
        for (index, stream) in (0..).zip(streams) {
            let address = format!("{}:{}", self.hosts[1].address(), PORT + index);
            let mut there = self.hosts[1].start_part(&Part::Receive(address.clone()))?;
            there.hear::<()>()?;
            running.push((self.hosts[0].start_part(&Part::Send(stream.clone(), address))?, there));
        }
        running.iter_mut().try_for_each(|(here, _)| here.hear::<()>())?;
        Ok(Streams(running))
    }

    /// What became of streams that flow for this long.
    pub(crate) fn measure(
        &self,
        carrier: Carrier,
        streams: &[Stream],
        time: Duration,
    ) -> Result<Vec<Outcome>> {
        let mut streams = self.streams(carrier, streams)?;
        streams.begin()?;
        thread::sleep(time);
        streams.end()
    }
}

/// Streams that are ready or flow.
pub(crate) struct Streams(Vec<(Running, Running)>);

impl Streams {
    pub(crate) fn begin(&mut self) -> Result<()> {
        self.0.iter_mut().try_for_each(|(here, _)| here.tell(&()))
    }

    /// Ends the publishers, and the subscribers when nothing is under way any more.
    pub(crate) fn end(self) -> Result<Vec<Outcome>> {
        let mut heres = Vec::new();
        let mut theres = Vec::new();
        for (mut here, there) in self.0 {
            here.close();
            heres.push(here);
            theres.push(there);
        }
        let sent = heres.iter_mut().map(Running::hear::<Sent>).collect::<Result<Vec<_>>>()?;
        thread::sleep(SETTLE);
        let taken = theres.into_iter().map(Running::end::<Taken>).collect::<Result<Vec<_>>>()?;
        Ok(sent.into_iter().zip(taken).map(|(sent, taken)| Outcome { sent, taken }).collect())
    }
}
