//! Tools find a daemon even if unrelated settings are wrong.

use super::*;

fn place(env: &[(&str, &str)], toml: Option<&str>) -> Result<DaemonLocation, ConfigError> {
    let mut disk = Disk::new();
    if let Some(toml) = toml {
        disk.put("/f/axon.toml", 0o644, toml);
    }
    DaemonLocation::resolve(pairs(env), Some(Path::new("/f/axon.toml")), &disk)
}

#[test]
fn a_place_is_where_the_whole_configuration_says() {
    for env in [
        &[][..],
        &[("ROS_DOMAIN_ID", "7"), ("XDG_RUNTIME_DIR", "/run/user/1")],
        &[("AXON_RUNTIME_DIR", "/f/run"), ("AXON_TRUSTED_UIDS", "0;7")],
    ] {
        let config = resolve(env, &[]).unwrap();
        assert_eq!(place(env, None).unwrap(), DaemonLocation::from(&config));
    }
    let toml = "runtime_dir = '/f/run'\ntrusted_uids = [7]";
    let config = with_file(&[], toml).unwrap();
    assert_eq!(place(&[], Some(toml)).unwrap(), DaemonLocation::from(&config));
}

#[test]
fn other_settings_may_be_wrong_and_a_file_may_be_anything() {
    let expected = place(&[("AXON_RUNTIME_DIR", "/f/run")], None).unwrap();
    let wrong = [
        ("AXON_SECURITY_MODE", "qkd"),
        ("AXON_KME_CA", "/nowhere"),
        ("AXON_ENCRYPTION_KEY", "x"),
        ("AXON_QKD_TYPO", "x"),
        ("AXON_STRICT_ENV", "maybe"),
        ("AXON_DAEMON_PATH", "/nowhere"),
    ];
    let runtime_dir = ("AXON_RUNTIME_DIR", "/f/run");
    let env = [&wrong[..], &[runtime_dir]].concat();
    assert_eq!(place(&env, None).unwrap(), expected);
    for toml in ["this is no TOML", "nonsense = 1", "[link]\nmtu = 'x'", "[qkd]\nsae_key = 7"] {
        assert_eq!(place(&[runtime_dir], Some(toml)).unwrap(), expected, "{toml}");
    }
    let beside = "runtime_dir = '/f/run'\nnonsense = 1\nkme_ca = '/nowhere'";
    assert_eq!(place(&[], Some(beside)).unwrap(), expected);
    let nowhere = [runtime_dir, ("AXON_CONFIG", "/nowhere/axon.toml")];
    assert_eq!(place(&nowhere, None).unwrap(), expected);
}

#[test]
fn daemon_place_refuses_wrong_settings() {
    for (name, value) in
        [("ROS_DOMAIN_ID", "-1"), ("AXON_RUNTIME_DIR", "x"), ("AXON_TRUSTED_UIDS", "me")]
    {
        assert_eq!(place(&[(name, value)], None).unwrap_err().variable(), name);
    }
}
