//! The client over QuKayDee, a QKD network simulated in the cloud; `docs/qukaydee.md` says how to
//! get an account and its certificates.
//!
//! Runs where `QUKAYDEE_ACCT` is the account's ID and `QUKAYDEE_CERTS` the directory of
//! `account-ACCT-server-ca-qukaydee-com.crt` and, for N = 1 and 2, `sae-N.crt` and `sae-N.key`. The
//! same steps are taken over the simulator in QuKayDee's place, so that they are known to work.

use std::io::Write;
use std::path::PathBuf;

use etsi_qkd014::sim::{Layout, Network, Pki, Site};
use etsi_qkd014::{Client, Error, KeyContainer};

/// The values of the variables.
#[derive(Debug)]
struct Account {
    id: String,
    certs: PathBuf,
    /// URL of a KME, `{n}` standing for its number.
    url: String,
}

impl Account {
    /// Reads the variables; the reason where the tests cannot run.
    fn read(variable: impl Fn(&str) -> Option<String>) -> Result<Self, String> {
        let set = |name: &str| {
            variable(name)
                .filter(|text| !text.is_empty())
                .ok_or_else(|| format!("{name} is not set"))
        };
        let id = set("QUKAYDEE_ACCT")?;
        let certs = set("QUKAYDEE_CERTS")?.into();
        let hosted = format!("https://kme-{{n}}.acct-{id}.etsi-qkd-api.qukaydee.com");
        let url = set("QUKAYDEE_URL").unwrap_or(hosted);
        Ok(Self { id, certs, url })
    }

    /// Returns the account in the environment, or `None` with the reason on standard error. The reason bypasses the
    /// harness, which would show it only with a failure.
    fn here() -> Option<Self> {
        let read = Self::read(|name| std::env::var(name).ok());
        read.inspect_err(|why| {
            let _ = writeln!(std::io::stderr(), "skipped: QuKayDee was not asked: {why}");
        })
        .ok()
    }

    /// Returns a client that is SAE `n` at KME `n`.
    fn client(&self, n: u8) -> Client {
        Client::builder()
            .kme_url(self.url.replace("{n}", &n.to_string()))
            .ca_file(self.certs.join(format!("account-{}-server-ca-qukaydee-com.crt", self.id)))
            .sae_cert_file(self.certs.join(format!("sae-{n}.crt")))
            .sae_key_file(self.certs.join(format!("sae-{n}.key")))
            .build()
            .unwrap()
    }
}

async fn status_names_both_ends(account: &Account) {
    let status = account.client(1).status("sae-2").await.unwrap();
    assert_eq!((status.master_sae_id.as_str(), status.slave_sae_id.as_str()), ("sae-1", "sae-2"));
    assert!(status.min_key_size <= status.key_size && status.key_size <= status.max_key_size);
    assert!(status.max_key_per_request >= 1);
}

async fn keys_are_the_same_at_both_ends(account: &Account) {
    let saes = [account.client(1), account.client(2)];
    for (master, slave) in [(0, 1), (1, 0)] {
        let id = |of: usize| format!("sae-{}", of + 1);
        let one = saes[master].enc_keys(id(slave)).size(256).via_get().send().await.unwrap();
        let two = saes[master].enc_keys(id(slave)).number(2).size(256).send().await.unwrap();
        let ids = |keys: &KeyContainer| -> Vec<String> {
            keys.keys.iter().map(|key| key.key_id().to_owned()).collect()
        };
        let request = saes[slave].dec_keys(id(master)).key_ids(ids(&one));
        let same = request.size(256).via_get().send().await.unwrap();
        assert!(same.into_single() == one.into_single());
        let request = saes[slave].dec_keys(id(master)).key_ids(ids(&two)).size(256);
        let same = request.send().await.unwrap();
        assert!(same.into_iter().zip(two).all(|(a, b)| a == b));
    }
}

/// Clause 5.4: checks that keys are removed once they were given.
async fn a_key_is_given_once(account: &Account) {
    let (master, slave) = (account.client(1), account.client(2));
    let key = master.enc_keys("sae-2").send().await.unwrap().into_single();
    slave.dec_keys("sae-1").key_id(key.key_id()).send().await.unwrap();
    let again = slave.dec_keys("sae-1").key_id(key.key_id()).send().await;
    assert!(again.is_err(), "the KME gave one key twice");
}

/// Clause 5.4: checks that an SAE for which the key was not drawn gets 401.
async fn a_key_is_not_for_its_master_to_draw_again(account: &Account) {
    let master = account.client(1);
    let key = master.enc_keys("sae-2").send().await.unwrap().into_single();
    let error = master.dec_keys("sae-1").key_id(key.key_id()).send().await.err();
    let code = error.as_ref().and_then(Error::status_code);
    assert!(matches!(code, Some(400 | 401)), "{error:?}");
}

#[tokio::test]
async fn status_over_qukaydee() {
    let Some(account) = Account::here() else { return };
    status_names_both_ends(&account).await;
}

#[tokio::test]
async fn keys_over_qukaydee() {
    let Some(account) = Account::here() else { return };
    keys_are_the_same_at_both_ends(&account).await;
}

#[tokio::test]
async fn once_over_qukaydee() {
    let Some(account) = Account::here() else { return };
    a_key_is_given_once(&account).await;
}

#[tokio::test]
async fn refusals_over_qukaydee() {
    let Some(account) = Account::here() else { return };
    a_key_is_not_for_its_master_to_draw_again(&account).await;
}

#[test]
fn missing_account_settings_are_named() {
    let none = Account::read(|_| None).unwrap_err();
    assert!(none.contains("QUKAYDEE_ACCT"), "{none}");
    let half = |name: &str| (name == "QUKAYDEE_ACCT").then(|| "1234".to_owned());
    assert!(Account::read(half).unwrap_err().contains("QUKAYDEE_CERTS"));
    let whole = |name: &str| (name != "QUKAYDEE_URL").then(|| "1234".to_owned());
    let url = Account::read(whole).unwrap().url;
    assert_eq!(url, "https://kme-{n}.acct-1234.etsi-qkd-api.qukaydee.com");
}

/// Starts two simulated KMEs, and writes the files of an account in QuKayDee's layout.
async fn stand_in() -> (Network, tempfile::TempDir, Account) {
    loop {
        // The URL has a place for the KME's number only, so both listen on the same port.
        let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = free.local_addr().unwrap().port();
        drop(free);
        let site = |n: u8| Site {
            kme: format!("kme-{n}"),
            bind: ([127, 0, 0, n], port).into(),
            saes: vec![format!("sae-{n}")],
        };
        let layout = Layout { sites: vec![site(1), site(2)] };
        let pki = Pki::create(&layout).unwrap();
        let dir = tempfile::tempdir().unwrap();
        pki.write(dir.path()).unwrap();
        let ca = dir.path().join("account-1234-server-ca-qukaydee-com.crt");
        std::fs::rename(dir.path().join("ca.pem"), ca).unwrap();
        // Another process may have taken the port in between.
        let Ok(network) = Network::builder().strict().layout(layout, pki).start().await else {
            continue;
        };
        let account = Account::read(|name| {
            Some(match name {
                "QUKAYDEE_ACCT" => "1234".to_owned(),
                "QUKAYDEE_CERTS" => dir.path().to_str().unwrap().to_owned(),
                _ => format!("https://127.0.0.{{n}}:{port}"),
            })
        });
        return (network, dir, account.unwrap());
    }
}

#[tokio::test]
async fn the_same_steps_over_the_simulator() {
    let (network, _dir, account) = stand_in().await;
    status_names_both_ends(&account).await;
    keys_are_the_same_at_both_ends(&account).await;
    a_key_is_given_once(&account).await;
    a_key_is_not_for_its_master_to_draw_again(&account).await;
    assert_eq!(network.kme("kme-1").unwrap().counters().keys_to_slaves, 3);
    assert_eq!(network.kme("kme-2").unwrap().counters().keys_to_slaves, 4);
}
