//! The acts of the liar.

use std::net::SocketAddr;

use axon_shm::ids::DaemonId;

use super::{LIAR, Lying, ONE_PATH, Role, TWO_PATHS, VICTIM, copies::CopyStream};
use crate::{
    engine::{
        links::simulated::LieAbout,
        sim::{host::PORT, network::Path},
    },
    link::{Elected, LinkMessage},
};

/// The link that a lie names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Name {
    None,
    /// A link of the liar.
    Own(Role),
    /// The link in use of an honest host.
    OfOther,
    Never,
    /// A link that ended.
    Ended,
}

/// The daemon that a lie names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pose {
    Liar,
    Honest,
    Nobody,
}

/// An act of the liar.
#[derive(Clone, Debug)]
pub(super) enum Act {
    /// It puts its second link in use, as an honest daemon does.
    Switch,
    /// The same, and the link in use ends in the same instant.
    SwitchAndEnd,
    /// It sends SWITCH_OVER so often.
    AskForSwitch {
        on: Role,
        times: u32,
    },
    Elect {
        on: Role,
        name: Name,
        election: u64,
        standby: Option<bool>,
        times: u32,
    },
    Dial {
        beside: Name,
        replaces: Name,
        path: usize,
        pose: Pose,
    },
    /// It renews both links.
    Renew,
    Copies {
        on: Role,
        copies: Vec<CopyStream>,
        ends: bool,
    },
    End(Role),
    /// Packets in one direction, or in both, of a path are dropped for so many milliseconds.
    Silence {
        path: usize,
        from_liar: bool,
        to_liar: bool,
        milliseconds: u64,
    },
}

impl Lying {
    /// Does an act. The time that it takes passes.
    pub(super) fn act(&mut self, act: &Act) {
        match act {
            Act::Switch => self.switch(),
            Act::SwitchAndEnd => {
                let in_use = self.roles(Role::InUse);
                self.switch();
                // The message and the end leave together.
                if let Some(in_use) = in_use {
                    self.end(in_use);
                }
            }
            Act::AskForSwitch { on, times } => {
                (0..*times).for_each(|_| self.say(*on, &LinkMessage::SwitchOver));
            }
            Act::Elect { on, name, election, standby, times } => {
                let link = self.name(*name).unwrap_or([0xe1; 16]);
                let next = self.links().map_or(0, |links| links.next_election());
                let election = if *election == u64::from(u32::MAX) { next } else { *election };
                let elected = Elected { link, election, standby: *standby };
                (0..*times).for_each(|_| self.say(*on, &LinkMessage::Elected(elected)));
            }
            Act::Dial { beside, replaces, path, pose } => {
                self.dial([*beside, *replaces], *path, *pose);
            }
            Act::Renew => {
                let paths = [Role::InUse, Role::Standby].map(Name::Own);
                for (path, name) in paths.into_iter().enumerate() {
                    self.dial([Name::None, name], path, Pose::Liar);
                }
            }
            Act::Copies { on, copies, ends } => {
                for copy in copies {
                    self.copy(*on, copy, *ends);
                }
            }
            Act::End(role) => {
                if let Some(number) = self.roles(*role) {
                    self.end(number);
                }
            }
            Act::Silence { path, from_liar, to_liar, milliseconds } => {
                let (liar, victim) = self.ends(*path);
                let none = || Some(Path { loss: 1.0, ..Path::default() });
                let network = &mut self.world.network;
                if *from_liar {
                    network.set_path_between(liar, victim, none());
                }
                if *to_liar {
                    network.set_path_between(victim, liar, none());
                }
                self.run(*milliseconds);
                let network = &mut self.world.network;
                network.set_path_between(liar, victim, None);
                network.set_path_between(victim, liar, None);
            }
        }
    }

    /// Returns the addresses of the liar and the victim on a path.
    pub(super) fn ends(&self, path: usize) -> (std::net::Ipv4Addr, std::net::Ipv4Addr) {
        let liar = &self.world.hosts[LIAR];
        let own = if path == 0 { Some(liar.address) } else { liar.second };
        (own.expect("two interfaces"), self.addresses[path])
    }

    pub(super) fn links(&mut self) -> Option<&mut crate::engine::links::Links> {
        self.world.hosts[LIAR].links_mut()
    }

    pub(super) fn switch(&mut self) {
        let (daemon, now) = (self.victim_daemon(), self.world.now);
        if let Some(links) = self.links() {
            links.switch_now(daemon, now);
        }
    }

    pub(super) fn end(&mut self, number: u64) {
        let now = self.world.now;
        if let Some(links) = self.links() {
            links.end(number, now);
        }
    }

    /// Sends a message over a link.
    pub(super) fn say(&mut self, on: Role, message: &LinkMessage) {
        if let (Some(number), Some(links)) = (self.roles(on), self.links()) {
            links.lie(number, message);
        }
    }

    /// Sends a stream over a link.
    pub(super) fn copy(&mut self, on: Role, copy: &CopyStream, ends: bool) {
        if let (Some(number), Some(links)) = (self.roles(on), self.links()) {
            links.open_data(number, &copy.encode(), ends);
        }
    }

    /// Returns the name of a link.
    pub(super) fn name(&mut self, name: Name) -> Option<[u8; 16]> {
        match name {
            Name::None => None,
            Name::Own(role) => {
                let number = self.roles(role)?;
                self.links()?.name_of(number)
            }
            Name::OfOther => {
                let daemon = self.world.hosts[TWO_PATHS].daemon;
                let links = self.world.hosts[VICTIM].links()?;
                links.name_of(*links.with_daemon(daemon)[0].last()?)
            }
            Name::Never => Some([0x5a; 16]),
            Name::Ended => self.ended,
        }
    }

    /// Dials the victim. HELLO names the link beside which the connection stands by, and the one that it replaces.
    pub(super) fn dial(&mut self, names: [Name; 2], path: usize, pose: Pose) {
        let [beside, replaces] = names.map(|name| self.name(name));
        let victim = &self.world.hosts[VICTIM];
        let (daemon, sae) = (victim.daemon, victim.sae());
        let address = SocketAddr::from((self.addresses[path], PORT));
        let (honest, now) = (self.world.hosts[ONE_PATH].daemon, self.world.now);
        let Some(links) = self.links() else { return };
        let before = match pose {
            Pose::Liar => None,
            Pose::Honest => Some(links.pose_as(honest, None)),
            Pose::Nobody => Some(links.pose_as(DaemonId([0x33; 16]), None)),
        };
        links.dial_lying(daemon, (sae, address), LieAbout { beside, replaces }, now);
        if let Some((own, key)) = before {
            // HELLO leaves once the handshake is complete, in qkd after an answer of the KME.
            self.run(60);
            if let Some(links) = self.links() {
                links.pose_as(own, key);
            }
        }
    }

    /// Remembers the name of the link in use, which a later lie calls ended.
    pub(super) fn remember(&mut self) {
        self.ended = self.name(Name::Own(Role::InUse)).or(self.ended);
    }
}
