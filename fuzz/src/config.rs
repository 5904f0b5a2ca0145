//! The configuration: an environment and an `axon.toml`, by any hand.

use std::{
    collections::BTreeMap,
    io,
    path::{Path, PathBuf},
};

use axon_daemon::internal::wire::SecurityTerms;
use axon_transport::config::{Config, FileFacts, FileKind, Files, Security};

/// A file system in which every file exists and is `axon.toml`.
struct OneFile<'a>(&'a [u8]);

impl Files for OneFile<'_> {
    fn read(&self, _: &Path) -> io::Result<Vec<u8>> {
        Ok(self.0.to_vec())
    }

    fn facts(&self, path: &Path) -> io::Result<FileFacts> {
        let directory = path.extension().is_some_and(|extension| extension == "d");
        let kind = if directory { FileKind::Directory } else { FileKind::Regular };
        Ok(FileFacts::new(kind, 0o700))
    }

    fn readable(&self, _: &Path) -> io::Result<()> {
        Ok(())
    }

    fn current_dir(&self) -> io::Result<PathBuf> {
        Ok("/home/robot".into())
    }
}

/// Lines `NAME=value`, and after a zero byte the text of `axon.toml`. The same input has the same
/// outcome; an error is one line about a setting; what is accepted is within the documented bounds,
/// in the mode that was asked for, and uses every setting of security that was given.
pub fn config(data: &[u8]) -> bool {
    let zero = data.iter().position(|byte| *byte == 0);
    let (lines, toml) = zero.map_or((data, None), |at| (&data[..at], Some(&data[at + 1..])));
    let Ok(lines) = std::str::from_utf8(lines) else { return false };
    let env: BTreeMap<&str, &str> = lines.lines().filter_map(|line| line.split_once('=')).collect();

    let resolve = || {
        let pairs = env.iter().map(|(name, value)| (name.into(), value.into()));
        let default_file = toml.map(|_| Path::new("/opt/axon/axon.toml"));
        Config::resolve(pairs, default_file, &OneFile(toml.unwrap_or_default()))
    };
    let outcome = resolve();
    assert_eq!(format!("{outcome:?}"), format!("{:?}", resolve()), "two outcomes of one input");
    let config = match outcome {
        Ok(config) => config,
        Err(error) => {
            let text = error.to_string();
            assert!(!text.chars().any(char::is_control), "not one line: {text:?}");
            assert!(text.contains(error.accepted()) || error.accepted().contains(char::is_control));
            return false;
        }
    };

    assert!(config.domain <= 232);
    assert!(config.max_message <= u64::from(u32::MAX));
    assert!(config.daemon_peers.len() <= 64 && config.static_peers.len() <= 32);
    assert!(config.warnings().iter().all(|warning| !warning.contains('\n')));
    let terms = SecurityTerms::of(&config);
    assert_eq!(terms.first_difference(&terms), None);

    let given = |prefix: &str| env.keys().any(|name| name.starts_with(prefix));
    let qkd = matches!(config.security, Security::Qkd(_));
    if let Some(mode) = env.get("AXON_SECURITY_MODE") {
        assert_eq!(*mode, if qkd { "qkd" } else { "classic" });
    }
    if qkd {
        assert!(!given("AXON_CLASSIC_"), "a setting of classic went unnoticed in qkd");
    } else {
        let lost = ["AXON_QKD_", "AXON_KME_", "AXON_SAE_"].into_iter().find(|p| given(p));
        assert_eq!(lost, None, "a setting of qkd went unnoticed in classic");
    }
    true
}

/// The three kinds of security, and every other setting.
pub fn seeds() -> Vec<Vec<u8>> {
    let qkd = "AXON_SECURITY_MODE=qkd\nAXON_QKD_KEY_MODE=session\nAXON_QKD_KEX=psk_dhe_ke\n\
               AXON_QKD_PEERS=sae-b;sae-c\nAXON_QKD_SESSION_MAX_AGE=60\n\
               AXON_KME_URL=https://kme:8443/a\nAXON_KME_CA=ca.pem\nAXON_KME_ID=kme-a\n\
               AXON_KME_QUIRKS=null-members\nAXON_KME_CONNECT_TIMEOUT=1\n\
               AXON_KME_ANSWER_TIMEOUT=2\nAXON_SAE_ID=sae-a\nAXON_SAE_CERT=/a.crt\n\
               AXON_SAE_KEY=/a.key\n";
    let classic = "AXON_CLASSIC_AUTH=pinned\nAXON_CLASSIC_KEY=/k\nAXON_CLASSIC_TRUST=/t\n\
                   AXON_QUIC_CIPHER=aes-256-gcm\n";
    let others = "ROS_DOMAIN_ID=7\nROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST\n\
                  ROS_STATIC_PEERS=192.0.2.1;robot\nXDG_RUNTIME_DIR=/run/user/1\n\
                  AXON_DAEMON=require\nAXON_DAEMON_PATH=/axon_daemon\nAXON_BIND_ADDRS=127.0.0.1\n\
                  AXON_DAEMON_PEERS=robot:61300;[2001:db8::1]:61300\n\
                  AXON_ADVERTISE_ADDRS=192.0.2.7\nAXON_RING_BUFFER_SIZE_MB=8\n\
                  AXON_MAX_MESSAGE_MB=16\nAXON_RELIABLE_QUEUE_MB=32\nAXON_SHM_COPY=1\n\
                  AXON_TRUSTED_UIDS=0;1000\nAXON_LOG=debug,quinn=warn\n";
    let file = "\0security_mode = \"classic\"\nclassic_auth = \"ca\"\nclassic_ca = \"ca.pem\"\n\
                classic_cert = \"c.pem\"\nclassic_key = \"k.pem\"\nclassic_crl = \"r.pem\"\n\
                trusted_uids = [1000]\nshm_copy = true\n[link]\ngrace_s = 5\nmtu = 1400\n";
    [qkd, classic, others, file, ""].map(|text| text.as_bytes().to_vec()).into()
}
