//! The permissions of the enclave that a session is in.

use std::time::SystemTime;

use super::SessionShared;
use crate::{
    config::Config,
    graph::Endpoint,
    session::{error::SessionError, options::SessionOptions},
};

/// Checks that the session's permissions, if it has some, are valid now and in its domain.
pub(in crate::session) fn check_domain(
    config: &Config,
    options: &SessionOptions,
) -> Result<(), SessionError> {
    match &options.permissions {
        Some(permissions) => Ok(permissions.check_domain(config.domain, SystemTime::now())?),
        None => Ok(()),
    }
}

impl SessionShared {
    /// Checks that the session's permissions, if it has some, allow an endpoint.
    pub(in crate::session) fn permit(&self, endpoint: &Endpoint) -> Result<(), SessionError> {
        let Some(permissions) = &self.core.options.permissions else { return Ok(()) };
        let (kind, topic) = (endpoint.kind, &endpoint.topic);
        permissions
            .check(kind, topic, self.core.config.domain, SystemTime::now())
            .map_err(|denial| SessionError::Permission { topic: topic.clone(), denial })
    }
}

#[cfg(test)]
mod tests {
    use crate::{
        EndpointSpec, Session, SessionError, SessionOptions,
        config::{Config, DaemonPolicy},
        qos::Qos,
        sros2::{EnclavePermissions, PermissionsError},
    };

    const PERMISSIONS: &str = "<dds><permissions><grant name='/arm'><subject_name>CN=/arm</subject_name>
        <validity><not_before>2020-01-01T00:00:00</not_before><not_after>2120-01-01T00:00:00</not_after></validity>
        <allow_rule><domains><id>5</id></domains>
        <publish><topics><topic>rt/out</topic><topic>rq/addRequest</topic></topics></publish>
        <subscribe><topics><topic>rt/in</topic><topic>rr/addReply</topic></topics></subscribe></allow_rule>
        <default>DENY</default></grant></permissions></dds>";

    fn open(domain: u32, permissions: &str) -> Result<Session, SessionError> {
        let config = Config::builder().daemon(DaemonPolicy::Off).domain(domain).build().unwrap();
        let permissions = EnclavePermissions::parse(permissions, "p", "/arm").unwrap();
        Session::open(&config, SessionOptions::new("arm").permissions(permissions))
    }

    fn spec(topic: &str) -> EndpointSpec {
        EndpointSpec::new(topic, "T", Qos::default())
    }

    #[test]
    fn a_session_creates_only_endpoints_its_enclave_permits() {
        let session = open(5, PERMISSIONS).unwrap();
        let _node = session.create_node("any", "/", "/arm").unwrap();
        let publisher = session.create_publisher(spec("/out")).unwrap();
        let _subscription = session.create_subscription(spec("/in")).unwrap();
        let _client = session.create_client(spec("/add")).unwrap();
        let denied = [
            session.create_publisher(spec("/in")).map(drop),
            session.create_publisher(spec("out")).map(drop),
            session.create_subscription(spec("/out")).map(drop),
            session.create_server(spec("/add")).map(drop),
            session.create_client(spec("/other")).map(drop),
        ];
        for denied in denied {
            assert!(matches!(denied, Err(SessionError::Permission { .. })), "{denied:?}");
        }
        let denied = session.create_publisher(spec("/in")).unwrap_err().to_string();
        let expected = "/in: enclave /arm may not publish rt/in: no rule allows it, and line 6 of p denies the rest";
        assert_eq!(denied, expected);
        // The graph contains no denied endpoint. The allowed endpoints work.
        assert_eq!(session.graph().endpoints.len(), 4, "{:?}", session.graph());
        publisher.publish(b"x").unwrap();
    }

    #[test]
    fn no_session_opens_where_its_permissions_do_not_count() {
        let refused = |domain, text: &str| match open(domain, text).unwrap_err() {
            SessionError::Permissions(error) => *error,
            other => panic!("{other}"),
        };
        let domain = refused(7, PERMISSIONS);
        assert!(matches!(domain, PermissionsError::Domain { domain: 7, .. }), "{domain}");
        let over = refused(5, &PERMISSIONS.replace("2120", "2021"));
        assert!(matches!(over, PermissionsError::NotValid { line: 2, .. }), "{over}");
    }
}
