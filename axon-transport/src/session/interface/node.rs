//! A node: a name in the graph, to which endpoints belong.

use std::fmt;

use crate::{
    graph::Endpoint,
    ids::Gid,
    session::{
        core::GuardCondition,
        endpoints::{Client, Publisher, Server, Subscription},
        error::SessionError,
        handle::Session,
        options::EndpointSpec,
    },
};

/// A node of a session. It is in the graph until it is dropped, with or without endpoints; its endpoints do not end
/// with it. Thread-safe.
///
/// AXON gives names no meaning: two nodes may have the same one, and the graph lists both.
///
/// ```
/// use axon_transport::{
///     EndpointSpec, Session, SessionOptions,
///     config::{Config, DaemonPolicy},
///     qos::Qos,
/// };
///
/// let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// let session = Session::open(&config, SessionOptions::new("robot"))?;
/// let lidar = session.create_node("lidar", "/front", "/")?;
/// let scan = EndpointSpec::new("/scan", "sensor_msgs/msg/LaserScan", Qos::sensor_data());
/// let publisher = lidar.create_publisher(scan)?;
/// assert_eq!(publisher.endpoint().node, "lidar");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Node {
    endpoint: Endpoint,
    graph: GuardCondition,
    session: Session,
}

impl Node {
    pub(super) fn new(endpoint: Endpoint, graph: GuardCondition, session: Session) -> Self {
        Self { endpoint, graph, session }
    }

    /// Returns a condition that is triggered after every change of the graph, once [`Session::graph`] shows it, and
    /// when a service or a client of the session finds or loses its other end.
    pub fn graph_changed(&self) -> &GuardCondition {
        &self.graph
    }

    /// Returns the node's GID.
    pub fn gid(&self) -> Gid {
        self.endpoint.gid
    }

    /// Returns the node's name.
    pub fn name(&self) -> &str {
        &self.endpoint.node
    }

    /// Returns the node's namespace.
    pub fn namespace(&self) -> &str {
        &self.endpoint.namespace
    }

    /// Returns the security enclave that it runs in.
    pub fn enclave(&self) -> &str {
        &self.endpoint.enclave
    }

    /// Returns the node's session.
    pub fn session(&self) -> &Session {
        &self.session
    }

    /// Like [`Session::create_publisher`], for this node; the node in `spec` is ignored.
    ///
    /// # Errors
    /// When the specification is out of bounds or there is no memory.
    pub fn create_publisher(&self, spec: EndpointSpec) -> Result<Publisher, SessionError> {
        self.session.create_publisher(self.own(spec))
    }

    /// Like [`Session::create_subscription`], for this node; the node in `spec` is ignored.
    ///
    /// # Errors
    /// When the specification is out of bounds.
    pub fn create_subscription(&self, spec: EndpointSpec) -> Result<Subscription, SessionError> {
        self.session.create_subscription(self.own(spec))
    }

    /// Like [`Session::create_server`], for this node; the node in `spec` is ignored.
    ///
    /// # Errors
    /// When the specification is out of bounds.
    pub fn create_server(&self, spec: EndpointSpec) -> Result<Server, SessionError> {
        self.session.create_server(self.own(spec))
    }

    /// Like [`Session::create_client`], for this node; the node in `spec` is ignored.
    ///
    /// # Errors
    /// When the specification is out of bounds or there is no memory.
    pub fn create_client(&self, spec: EndpointSpec) -> Result<Client, SessionError> {
        self.session.create_client(self.own(spec))
    }

    fn own(&self, spec: EndpointSpec) -> EndpointSpec {
        let (node, namespace) = (self.endpoint.node.clone(), self.endpoint.namespace.clone());
        EndpointSpec { node, namespace, ..spec }
    }
}

impl fmt::Debug for Node {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Node").field(&self.endpoint).finish()
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        self.session.forget_endpoint(&self.endpoint.gid);
    }
}
