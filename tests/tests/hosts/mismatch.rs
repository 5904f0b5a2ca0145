//! Tests that hosts whose settings differ do not link, and that both report the setting.

use std::{thread, time::Duration};

use super::{
    mode::{Kmes, Settings, classic},
    pair::Plan,
    process::until,
};

/// Checks that both hosts name `variable`, and that there is no link.
fn differ(settings: [Settings; 2], variable: &str) {
    let hosts = Plan::new(settings).start();
    for host in &hosts {
        host.wait_refusal(variable, |text| text.contains(variable));
    }
    for host in &hosts {
        let status = host.status();
        assert!(status.links.is_empty(), "{:?}", status.links);
    }
}

#[test]
fn classic_against_qkd() {
    let kmes = Kmes::start();
    differ([classic(&[]), kmes.settings(1, &[])], "AXON_SECURITY_MODE");
}

#[test]
fn messages10_against_session() {
    let kmes = Kmes::start();
    let modes = ["messages10", "session"];
    let settings = [0, 1].map(|h| kmes.settings(h, &[("AXON_QKD_KEY_MODE", modes[h])]));
    differ(settings, "AXON_QKD_KEY_MODE");
}

#[test]
fn psk_ke_against_psk_dhe_ke() {
    let kmes = Kmes::start();
    let kexes = ["psk_ke", "psk_dhe_ke"];
    let settings = [0, 1].map(|h| kmes.settings(h, &[("AXON_QKD_KEX", kexes[h])]));
    differ(settings, "AXON_QKD_KEX");
}

#[test]
fn another_cipher() {
    let ciphers = ["chacha20-poly1305", "aes-256-gcm"];
    differ(ciphers.map(|c| classic(&[("AXON_QUIC_CIPHER", c)])), "AXON_QUIC_CIPHER");
}

#[test]
fn pinned_against_none() {
    let dir = tempfile::tempdir().unwrap();
    let [a, _] = super::mode::pinned(dir.path(), [[false, true], [true, false]]);
    differ([a, classic(&[])], "AXON_CLASSIC_AUTH");
}

#[test]
fn another_domain_is_none_of_our_business() {
    let plan = Plan { other_domain: true, ..Plan::new([classic(&[]), classic(&[])]) };
    let hosts = plan.start();
    let wait = || hosts.iter().all(|host| host.status().uptime.as_secs() >= 4);
    until("both had time to find each other", wait);
    thread::sleep(Duration::from_millis(100));
    for host in &hosts {
        let status = host.status();
        assert!(status.links.is_empty(), "{:?}", status.links);
        assert!(status.refusals.is_empty(), "{:?}", status.refusals);
    }
}
