//! The order in which a connection becomes a link.
//!
//! Both sides send HELLO. In qkd the client proves its name. The side with the lower daemon id sends ELECTED. Only
//! after that may graph, routes, data and ordinary keys follow (`docs/formats.md`, section 6).

use crate::wire::{keys::KeyMessage, link::LinkMessage};

/// The side of the TLS handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The side that dialled.
    Client,
    /// The side that was dialled.
    Server,
}

/// A message before its time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{message} is not allowed {when}")]
pub struct OutOfOrder {
    /// The message.
    pub message: &'static str,
    /// The step at which it came.
    pub when: &'static str,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum OrderStep {
    Hello,
    /// qkd: the client's name is being proven.
    Proof,
    Election,
    /// The connection stands by beside the link in use.
    Standby,
    Open,
}

/// Judges each message that arrives on a connection's control stream.
#[derive(Clone, Debug)]
pub struct MessageOrder {
    side: Side,
    qkd: bool,
    /// Whether the peer is the electing side.
    peer_elects: bool,
    step: OrderStep,
    hello_seen: bool,
}

impl MessageOrder {
    /// Returns the order for a fresh connection, in qkd or classic.
    pub fn new(side: Side, qkd: bool) -> Self {
        Self { side, qkd, peer_elects: false, step: OrderStep::Hello, hello_seen: false }
    }

    /// Records that the peer's HELLO was checked; `peer_elects` if the peer's daemon id is the lower one.
    pub fn hello_checked(&mut self, peer_elects: bool) {
        self.peer_elects = peer_elects;
        self.step = if self.qkd { OrderStep::Proof } else { OrderStep::Election };
    }

    /// Records the proof. Server: READY with the right proof came. Client: it sent READY.
    pub fn proven(&mut self) {
        if self.step == OrderStep::Proof {
            self.step = OrderStep::Election;
        }
    }

    /// Records that this side elected the connection, or accepted the peer's ELECTED.
    pub fn elected(&mut self) {
        if matches!(self.step, OrderStep::Election | OrderStep::Standby) {
            self.step = OrderStep::Open;
        }
    }

    /// Records that the connection was elected to stand by.
    pub fn stands_by(&mut self) {
        if self.step == OrderStep::Election {
            self.step = OrderStep::Standby;
        }
    }

    /// Returns whether the link is open for graph, routes and data.
    pub fn is_open(&self) -> bool {
        self.step == OrderStep::Open
    }

    /// Checks that `message` may come now.
    ///
    /// # Errors
    /// [`OutOfOrder`]; the caller then closes the connection.
    pub fn accept(&mut self, message: &LinkMessage) -> Result<(), OutOfOrder> {
        let allowed = match (message, self.step) {
            (LinkMessage::Hello(_), OrderStep::Hello) => {
                !std::mem::replace(&mut self.hello_seen, true)
            }
            (LinkMessage::Hello(_), _) => false,
            // The server announces the key that proves the client's name.
            (LinkMessage::Keys(KeyMessage::Announce(_)), OrderStep::Proof) => {
                self.side == Side::Client
            }
            (
                LinkMessage::Keys(KeyMessage::Ready { .. } | KeyMessage::Failed { .. }),
                OrderStep::Proof,
            ) => self.side == Side::Server,
            (LinkMessage::Elected(_), OrderStep::Election) => self.peer_elects,
            (LinkMessage::Elected(elected), OrderStep::Standby) => {
                self.peer_elects && elected.standby != Some(true)
            }
            // The side that elects need not ask. The request may cross its ELECTED.
            (LinkMessage::SwitchOver, OrderStep::Standby | OrderStep::Open) => !self.peer_elects,
            (LinkMessage::Keepalive, step) => step != OrderStep::Hello,
            // Key announcements exist in qkd alone.
            (LinkMessage::Keys(_), OrderStep::Standby | OrderStep::Open) => self.qkd,
            (LinkMessage::Elected(_), OrderStep::Open) => false,
            (_, OrderStep::Open) => true,
            _ => false,
        };
        if allowed {
            return Ok(());
        }
        let when = match self.step {
            OrderStep::Hello => "before HELLO",
            OrderStep::Proof => "before the client's name is proven",
            OrderStep::Election => "before the link is elected",
            OrderStep::Standby => "while the link stands by",
            OrderStep::Open => "on an open link",
        };
        Err(OutOfOrder { message: message.name(), when })
    }
}

impl LinkMessage {
    /// Returns the message's name in `docs/formats.md`.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Hello(_) => "HELLO",
            Self::Elected(_) => "ELECTED",
            Self::SwitchOver => "SWITCH_OVER",
            Self::Graph(_) => "GRAPH",
            Self::GraphResync(_) => "GRAPH_RESYNC",
            Self::Subscribe(_) => "SUBSCRIBE",
            Self::Unsubscribe(_) => "UNSUBSCRIBE",
            Self::RouteReady(_) => "ROUTE_READY",
            Self::Keepalive => "KEEPALIVE",
            Self::Asserted(_) => "ASSERTED",
            Self::Received(_) => "RECEIVED",
            Self::RouteRefused(_) => "ROUTE_REFUSED",
            Self::RouteUnasked(_) => "ROUTE_UNASKED",
            Self::Owners(_) => "OWNERS",
            Self::LinkClosed(_) => "LINK_CLOSED",
            Self::ReceiveLimits(_) => "RECEIVE_LIMITS",
            Self::Denied(_) => "DENIED",
            Self::AccessCheck(_) => "ACCESS_CHECK",
            Self::AccessDecisions(_) => "ACCESS_DECISIONS",
            Self::Keys(m) => m.name(),
        }
    }
}
