//! A builder can express exactly the settings that the environment can express.

use std::net::IpAddr;

use super::*;

/// Every setting of `qkd` and of both modes.
fn all_of_qkd() -> ConfigBuilder {
    Config::builder()
        .security_mode(SecurityMode::Qkd)
        .qkd_key_mode(KeyMode::Session)
        .qkd_kex(QkdKex::PskDheKe)
        .qkd_peers(QkdPeers::Listed(vec!["sae-b".into(), "sae-c".into()]))
        .qkd_session_max_age(Duration::from_secs(60))
        .kme_url("https://kme:8443")
        .kme_ca("/etc/hostname")
        .kme_id("KME A")
        .kme_quirks(["null-members", "any-key-id"])
        .kme_connect_timeout(Duration::from_secs(4))
        .kme_answer_timeout(Duration::from_secs(7))
        .sae_id("sae-a")
        .sae_cert("/etc/hostname")
        .sae_key("/etc/hostname")
        .quic_cipher(QuicCipher::Aes256Gcm)
        .daemon(DaemonPolicy::Require)
        .daemon_path("/bin/sh")
        .runtime_dir("/f/run")
        .bind_addrs(["127.0.0.2", "::1"].map(|a| a.parse::<IpAddr>().unwrap()))
        .daemon_peers(["robot-1", "[::1]:9"])
        .advertise_addrs(["192.0.2.1".parse::<IpAddr>().unwrap()])
        .ring_buffer_size_mb(1)
        .max_message_mb(4_095)
        .reliable_queue_mb(2)
        .shm(false)
        .shm_copy(true)
        .trusted_uids([0, 1_000])
        .access_file("/f/access.toml")
        .log("info")
        .config("/dev/null")
        .domain(232)
        .discovery_range(DiscoveryRange::Localhost)
        .static_peers(["10.1.1.1", "robot-2"])
        .link_grace(Duration::from_secs(3))
        .link_stalled(Duration::from_secs(4))
        .link_mtu(9_000)
        .link_graph_mb(4)
        .link_held_mb(32)
        .link_poll(LinkPoll::Never)
        .link_qlog("/var/qlog")
        .link_congestion(Congestion::Cubic)
        .link_compression(LinkCompression::Never)
        .link_paths(2)
}

fn all_of_classic() -> ConfigBuilder {
    Config::builder()
        .classic_auth(ClassicAuth::Ca)
        .classic_key("/f/key.pem")
        .classic_trust("/f/trust")
        .classic_ca("/f/ca.pem")
        .classic_cert("/f/cert.pem")
        .classic_crl("/f/crl.pem")
}

#[test]
fn every_setting_has_a_method() {
    let given: Vec<&str> =
        [all_of_qkd(), all_of_classic()].iter().flat_map(ConfigBuilder::names).collect();
    for name in names::SETTINGS.iter().chain(names::LINK).chain([&names::CONFIG]) {
        assert!(given.contains(name), "{name}");
    }
}

fn without_origin(config: &Config) -> String {
    format!("{:?}", Config { daemon_env: DaemonEnv::default(), ..config.clone() })
}

#[test]
fn a_built_config_equals_that_of_its_environment() {
    let dir = tempfile::tempdir().unwrap();
    let key = dir.path().join("key");
    std::fs::write(&key, "").unwrap();
    std::fs::set_permissions(&key, std::os::unix::fs::PermissionsExt::from_mode(0o600)).unwrap();
    let access = dir.path().join("access.toml");
    std::fs::write(&access, "[[allow]]\npeer = \"sae-b\"\npublish = \"/cmd_vel\"").unwrap();
    let built = all_of_qkd().sae_key(&key).access_file(&access).build().unwrap();
    assert!(!built.daemon_env.inherits);
    let environment = built.daemon_env.variables.clone().into_iter();
    let environment: Vec<_> = environment.filter_map(|(n, value)| Some((n, value?))).collect();
    assert!(environment.iter().all(|(name, _)| {
        names::SETTINGS
            .iter()
            .chain(names::LINK)
            .chain(sources::FOREIGN)
            .chain([&names::CONFIG])
            .any(|known| name == known)
    }));
    let read = Config::resolve(environment, None, &OsFiles).unwrap();
    assert_eq!(without_origin(&read), without_origin(&built));
    let bounds = (built.link.graph, built.link.held);
    assert_eq!((built.link.mtu, bounds), (9_000, (4 << 20, 32 << 20)));
    assert_eq!(built.link.poll, LinkPoll::Never);
    assert_eq!(built.link.qlog.as_deref(), Some(Path::new("/var/qlog")));
    assert_eq!(built.link.congestion, Congestion::Cubic);
    assert_eq!(built.link.compression, LinkCompression::Never);
    assert_eq!((built.domain, built.static_peers.len()), (232, 2));
    assert_eq!(built.range, DiscoveryRange::Localhost);
    let peer = crate::access::Principal::Name("sae-b");
    assert!(!built.access.check(peer, crate::access::Verb::Publish, "/scan").allowed());
}

#[test]
fn the_default_is_the_empty_environment_and_names_no_file_to_its_daemon() {
    let default = Config::default();
    assert_eq!(without_origin(&default), without_origin(&resolve(&[], &[]).unwrap()));
    let daemon_env = default.daemon_env;
    assert!(!daemon_env.inherits);
    assert_eq!(
        daemon_env.variables,
        BTreeMap::from([("AXON_CONFIG".into(), Some("/dev/null".into()))])
    );
}

#[test]
fn no_entry_becomes_two_entries_or_every_peer() {
    let listed = |sae: &str| QkdPeers::Listed(vec![sae.into()]);
    for evil in ["*", "", " ", "sae-b;sae-c", "sae-b,sae-c", " sae-b", "sae-b\n", "*;sae-b"] {
        for (builder, name) in [
            (all_of_qkd().qkd_peers(listed(evil)), "AXON_QKD_PEERS"),
            (Config::builder().daemon_peers([evil]), "AXON_DAEMON_PEERS"),
            (Config::builder().static_peers([evil]), "ROS_STATIC_PEERS"),
            (Config::builder().kme_quirks([evil]), "AXON_KME_QUIRKS"),
        ] {
            let error = builder.build().unwrap_err();
            assert_eq!(error.variable(), name, "{evil:?}");
            assert!(error.to_string().contains("ConfigBuilder::"), "{error}");
        }
    }
    for (builder, name) in [
        (all_of_qkd().qkd_peers(QkdPeers::Listed(vec![])), "AXON_QKD_PEERS"),
        (Config::builder().bind_addrs([]), "AXON_BIND_ADDRS"),
    ] {
        assert_eq!(builder.build().unwrap_err().variable(), name, "nobody is not everybody");
    }
}

#[test]
fn the_builder_refuses_the_values_the_environment_refuses() {
    let new = Config::builder;
    for (builder, name) in [
        (new().security_mode(SecurityMode::Qkd), "AXON_SAE_ID"),
        (new().sae_id("sae-a"), "AXON_SAE_ID"),
        (new().classic_auth(ClassicAuth::Pinned), "AXON_CLASSIC_KEY"),
        (new().classic_auth(ClassicAuth::None).classic_key("/dev/null"), "AXON_CLASSIC_KEY"),
        (new().classic_ca("/dev/null"), "AXON_CLASSIC_CA"),
        (new().kme_url("http://kme"), "AXON_KME_URL"),
        (new().domain(233), "ROS_DOMAIN_ID"),
        (new().runtime_dir("relative"), "AXON_RUNTIME_DIR"),
        (new().runtime_dir(""), "AXON_RUNTIME_DIR"),
        (new().log("loud"), "AXON_LOG"),
        (new().max_message_mb(4_096), "AXON_MAX_MESSAGE_MB"),
        (new().link_mtu(1_199), "AXON_LINK_MTU"),
        (new().link_qlog("relative"), "AXON_LINK_QLOG"),
        (new().link_qlog("/dev/null"), "AXON_LINK_QLOG"),
        (new().link_stalled(Duration::ZERO), "AXON_LINK_STALLED_S"),
        (new().link_grace(Duration::from_millis(1)), "AXON_LINK_GRACE_S"),
        (new().daemon_path("/nowhere/daemon"), "AXON_DAEMON_PATH"),
        (new().config("/nowhere/axon.toml"), "AXON_CONFIG"),
        (new().log(OsString::from_vec(vec![b'a', 0, b'b']).into_string().unwrap()), "AXON_LOG"),
        (new().classic_key(Path::new(&OsString::from_vec(vec![0xff]))), "AXON_CLASSIC_KEY"),
    ] {
        let error = builder.build().unwrap_err();
        assert_eq!(error.variable(), name, "{error}");
    }
    let error = new().max_message_mb(0).build().unwrap_err().to_string();
    assert!(error.starts_with("AXON_MAX_MESSAGE_MB (ConfigBuilder::max_message_mb):"), "{error}");
}

#[test]
fn relative_files_are_found_from_any_directory() {
    let built = Config::builder().config("Cargo.toml").build();
    // It is no axon.toml, but found.
    assert!(built.unwrap_err().to_string().contains("Cargo.toml"));
    let daemon_env =
        DaemonEnv::whole(pairs(&[("AXON_CLASSIC_KEY", "key.pem")]), None, &Disk::new());
    let key = daemon_env.variables[OsStr::new("AXON_CLASSIC_KEY")].clone();
    assert_eq!(key, Some("/f/key.pem".into()));
}

#[test]
fn variables_of_the_section_link_win_over_it_and_belong_in_the_environment() {
    let file = "[link]\ngrace_s = 3\nmtu = 9000";
    let link = with_file(&[("AXON_LINK_GRACE_S", "4")], file).unwrap().link;
    assert_eq!((link.grace.as_secs(), link.mtu), (4, 9_000));
    let error = with_file(&[], "link_mtu = 1400").unwrap_err();
    assert_eq!(error.variable(), "AXON_LINK_MTU");
    assert!(error.to_string().contains("mtu in the section [link]"), "{error}");
    let error = resolve(&[], &[("AXON_LINK_MTO", "1400")]).unwrap_err();
    assert!(error.to_string().contains("did you mean AXON_LINK_MTU"), "{error}");
}
