//! Settings and requests that cannot work, and those that only look as if they could not.

use std::io::Write;
use std::time::Duration;

use etsi_qkd014::sim::{Fault, Network};
use etsi_qkd014::{Client, ClientBuilder, Error, Quirks, RetryPolicy};

async fn network() -> Network {
    Network::builder()
        .strict()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
        .kme("kme-b", "127.0.0.1:0".parse().unwrap(), ["sae-b"])
        .start()
        .await
        .unwrap()
}

fn refused(builder: ClientBuilder) -> String {
    let shown = format!("{builder:?}");
    let Err(error) = builder.build() else { panic!("taken: {shown}") };
    assert!(matches!(error, Error::Config { .. }), "{error}");
    format!("{shown} {error} {error:?}")
}

#[tokio::test]
async fn urls_that_are_no_kmes_are_refused() {
    let network = network().await;
    let at = |url: &str| network.client_builder("sae-a").kme_url(url);
    for url in [
        "https://[fe80::1%25eth0]/",
        "https://[fe80::1%eth0]:8443",
        "https://kme:99999",
        "https://kme:port",
        "https://kme/?number=1",
        "https://kme/#x",
        "https://",
        "https:",
        "//kme",
        "kme:8443",
        "ftp://kme",
        "http://kme",
        "https://k me",
        "https://kme%00",
        "data:text/plain,x",
        "unix:/run/kme",
    ] {
        assert!(refused(at(url)).contains("kme_url"), "{url}");
    }
}

#[tokio::test]
async fn a_password_in_a_url_is_refused_and_not_shown() {
    let network = network().await;
    let urls = [
        "https://robot:sesame@kme",
        "https://robot:sesame@kme:99999",
        "http://robot:sesame@kme",
        "https://robot:sesame@",
        "https://sesame@kme",
    ];
    for url in urls {
        let shown = refused(network.client_builder("sae-a").kme_url(url));
        assert!(!shown.contains("sesame"), "{shown}");
    }
}

#[tokio::test]
async fn a_scheme_in_capitals_and_a_slash_at_the_end_are_the_same_url() {
    let network = network().await;
    let url = network.kme("kme-a").unwrap().url().to_owned();
    for url in [url.replace("https", "HTTPS"), format!("{url}/"), format!(" {url}\n")] {
        let client = network.client_builder("sae-a").kme_url(&url).build().unwrap();
        client.status("sae-b").await.unwrap();
    }
}

#[tokio::test]
async fn times_without_end_are_no_panic() {
    let network = network().await;
    let policy = RetryPolicy::none().status(1).pause(Duration::MAX, Duration::MAX);
    let endless = || {
        let builder = network.client_builder("sae-a").retry(policy.clone());
        builder.timeout(Duration::MAX).deadline(Duration::MAX).connect_timeout(Duration::MAX)
    };
    endless().build().unwrap().enc_keys("sae-b").send().await.unwrap();
    // An hour is within this deadline: the call waits, as the KME asked.
    network.kme("kme-a").unwrap().inject(Fault::Busy(u64::MAX), 1);
    let client = endless().build().unwrap();
    let waiting = tokio::time::timeout(Duration::from_millis(300), client.status("sae-b")).await;
    assert!(waiting.is_err() || waiting.unwrap().is_err());
}

#[tokio::test]
async fn requests_beyond_the_limits_are_not_sent() {
    let network = network().await;
    let client = |builder: ClientBuilder| builder.retry(RetryPolicy::none()).build().unwrap();
    let plain = client(network.client_builder("sae-a"));
    let small = client(network.client_builder("sae-a").max_body(1000));
    let requests = [
        plain.enc_keys("sae-b").number(u32::MAX).send().await,
        plain.enc_keys("sae-b").number(16_385).send().await,
        // 1 MiB holds no 10,000 keys of 100 bytes.
        plain.enc_keys("sae-b").number(10_000).size(800).send().await,
        plain.enc_keys("sae-b").size(1 << 31).send().await,
        small.enc_keys("sae-b").number(20).size(256).send().await,
        small.enc_keys("sae-b").number(100).send().await,
        small.enc_keys("sae-b").number(20).size(256).via_get().send().await,
        plain.enc_keys("sae-b").additional_slave_sae_ids([""]).send().await,
        plain.enc_keys("sae-b").additional_slave_sae_ids(["a\0"]).send().await,
        // The key would come under a key_ID that is then refused.
        plain.dec_keys("sae-b").key_id("key-7").send().await,
        small.dec_keys("sae-b").key_ids((0..30).map(id)).size(256).send().await,
    ];
    for result in requests {
        let error = result.err().expect("it must be refused");
        assert!(matches!(error, Error::Request { .. }), "{error}");
    }
    assert_eq!(network.kme("kme-a").unwrap().counters(), Default::default());
    // The limit is not stricter than the answer: 5 keys of 256 bits have 518 bytes.
    let tight = client(network.client_builder("sae-a").max_body(530));
    tight.enc_keys("sae-b").number(5).size(256).send().await.unwrap();
    let numbered = client(network.client_builder("sae-a").quirks(Quirks::ANY_KEY_ID));
    let error = numbered.dec_keys("sae-b").key_id("key-7").send().await.err().unwrap();
    assert!(!matches!(error, Error::Request { .. }), "it is sent: {error}");
}

fn id(number: usize) -> String {
    format!("00000000-0000-4000-8000-{number:012}")
}

#[tokio::test]
async fn a_client_with_another_retry_policy_shares_connections_and_known_status() {
    let network = network().await;
    let kme = network.kme("kme-a").unwrap();
    let patient = RetryPolicy::none().enc_keys(5).status(5).pause(Duration::ZERO, Duration::ZERO);
    let client = network.client_builder("sae-a").retry(patient).build().unwrap();
    client.status("sae-b").await.unwrap();
    let once = client.with_retry(RetryPolicy::none());
    kme.inject(Fault::Empty, 2);
    assert!(once.enc_keys("sae-b").send().await.is_err());
    assert_eq!(kme.counters().enc_keys_calls, 1, "made once");
    client.enc_keys("sae-b").send().await.unwrap();
    assert_eq!(kme.counters().enc_keys_calls, 3, "the first keeps its policy");
    // The size that the status named counts there too.
    kme.inject(Fault::WrongLength, 1);
    let error = once.enc_keys("sae-b").send().await.err().unwrap();
    assert!(matches!(error.cause(), Error::Check { .. }), "{error}");
}

#[cfg(unix)]
#[tokio::test]
async fn a_private_key_may_come_through_a_pipe_and_an_endless_file_is_refused() {
    let network = network().await;
    let (key, mut pipe) = std::io::pipe().unwrap();
    let pem = network.sae("sae-a").unwrap().key_pem().to_owned();
    // Longer than one reading, with what `openssl` writes before a key.
    let text = format!("{}\n{pem}", "comment ".repeat(2000));
    let writing = std::thread::spawn(move || pipe.write_all(text.as_bytes()));
    use std::os::fd::AsRawFd;
    let path = format!("/dev/fd/{}", key.as_raw_fd());
    let client = network.client_builder("sae-a").sae_key_file(path).build().unwrap();
    writing.join().unwrap().unwrap();
    client.status("sae-b").await.unwrap();
    let endless = network.client_builder("sae-a").sae_key_file("/dev/zero");
    assert!(refused(endless).contains("larger than"));
    assert!(refused(network.client_builder("sae-a").sae_key_file("/dev")).contains("sae_key"));
}

#[tokio::test]
async fn clients_without_a_runtime_fail_when_made_or_work_when_used() {
    // Made outside of any runtime, used inside of one.
    let network = network().await;
    let settings = network.client_builder("sae-a");
    let client: Client = std::thread::spawn(|| settings.build().unwrap()).join().unwrap();
    client.status("sae-b").await.unwrap();
}
