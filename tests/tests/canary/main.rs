//! Tests which blocks of memory are released with a key in them.
//!
//! Between the making of a client and the end of its runtime, every block that is freed, or left behind by growing, is
//! kept unchanged. It is searched for each key of the call, raw and as base64. The same holds for all keys of a pool,
//! and for the private key of the SAE. No block that etsi-qkd014 allocated may hold as much as eight bytes of a key.
//! Blocks of the TLS and HTTP libraries that do are listed by call site: a new site fails the test.
//!
//! The tests are here and not with the crate, which forbids unsafe code: an allocator needs it.

mod kme;
#[path = "../kmes/mod.rs"]
mod kmes;
mod pool;
mod quarantine;
mod sae_key;
mod search;
mod trace;

use std::cell::RefCell;
use std::time::Duration;

use etsi_qkd014::secrecy::ExposeSecret;
use etsi_qkd014::{Client, ClientBuilder, Error, Key, KeyContainer};
use kme::{key, key_id};
use kmes::Kmes;
use search::{Needles, Sites};
use tokio::runtime::{Builder, Runtime};

/// Number of keys: their answer exceeds a TLS record and hyper's first buffer.
const MANY: u64 = 300;

/// The memory below the last chunk, where the connection's task, on another thread, was late.
const LATE: &str = "hyper::proto::h1::io::Buffered<T,B>::poll_read_from_io";

/// The call sites that may leave key bytes in blocks, as the documentation of etsi-qkd014 says.
const LIBRARIES: [&str; 2] = [
    // The plaintext of a record, waiting for its reader.
    "rustls::msgs::base::Payload::into_vec",
    // Bytes from the socket, decrypted in place.
    "rustls::msgs::deframer::buffers::DeframerVecBuffer::read",
];

/// The KMEs' process.
#[test]
fn kmes() {
    kme::serve_if_asked();
}

#[test]
fn the_canary_sings() {
    let _turn = quarantine::turn();
    let (_, freed) = quarantine::during(|| {
        let mut grown = Vec::with_capacity(32);
        grown.extend_from_slice(&key(1));
        grown.reserve(100);
        grown.fill(0);
        drop(String::from_utf8(key(2)[..9].iter().flat_map(|b| [b & 1, *b & 1]).collect()));
        drop(zeroize::Zeroizing::new(key(3).to_vec()));
    });
    let pieces = |number: u64| {
        let needles = Needles::of([&key(number)[..]]);
        freed.iter().map(|block| needles.count(&block.bytes())).sum::<usize>()
    };
    assert_eq!((pieces(1), pieces(2), pieces(3)), (25, 0, 0));
}

fn runtimes() -> [Runtime; 2] {
    let mut builders = [Builder::new_current_thread(), Builder::new_multi_thread()];
    builders.each_mut().map(|builder| builder.enable_all().worker_threads(2).build().unwrap())
}

/// Makes a client, calls, drops both and the runtime, and judges the released blocks.
fn judge<T>(
    name: &str,
    settings: impl Fn() -> ClientBuilder,
    call: impl AsyncFn(&Client) -> T,
    keys: impl Fn(&T) -> Vec<Vec<u8>>,
) {
    for (runtime, kind) in runtimes().into_iter().zip(["one thread", "threads"]) {
        let (result, freed) = quarantine::during(|| {
            let client = settings().build().unwrap();
            let result = runtime.block_on(call(&client));
            drop(client);
            drop(runtime);
            result
        });
        let keys = keys(&result);
        let needles = Needles::of(keys.iter().map(Vec::as_slice));
        let sites = Sites::search(&freed, &needles);
        let mut unknown = String::new();
        for (site, found) in &sites.0 {
            eprintln!("{name}, {kind}: {} blocks, {} pieces: {site}", found.blocks, found.pieces);
            let late = kind == "threads" && site == LATE;
            if !late && !LIBRARIES.contains(&site.as_str()) {
                unknown.push_str(&format!("{site}\n{}\n", found.stacks));
            }
        }
        assert!(unknown.is_empty(), "{name}, {kind}: blocks with key bytes of\n{unknown}");
    }
}

fn script_keys<T>(_: &T) -> Vec<Vec<u8>> {
    (0..MANY).map(|number| key(number).to_vec()).collect()
}

fn exposed(keys: &[Key]) -> Vec<Vec<u8>> {
    keys.iter().map(|key| key.expose_secret().to_vec()).collect()
}

type Answer = Result<KeyContainer, Error>;

/// Judges a script by `enc_keys` and by `dec_keys`, for one key and for many.
fn judge_script(
    script: &str,
    settings: impl Fn(ClientBuilder) -> ClientBuilder,
    size: u32,
    expected: impl Fn(Option<Answer>),
) {
    let _turn = quarantine::turn();
    let kmes = Kmes::start();
    let settings = || settings(kmes.scripted());
    for number in [1, MANY] {
        let name = format!("{script}, enc_keys of {number}");
        let call = async |client: &Client| {
            let call = client.enc_keys(script).number(number as u32).size(size).send();
            // Time enough for all that the script sends at once.
            expected(tokio::time::timeout(Duration::from_secs(1), call).await.ok());
        };
        judge(&name, settings, call, script_keys);
        let name = format!("{script}, dec_keys of {number}");
        let call = async |client: &Client| {
            let ids = (0..number).map(key_id);
            let call = client.dec_keys(script).key_ids(ids).size(size).send();
            expected(tokio::time::timeout(Duration::from_secs(1), call).await.ok());
        };
        judge(&name, settings, call, script_keys);
    }
}

fn failed(answer: Option<Answer>) -> Error {
    match answer.expect("the call ends by itself") {
        Ok(_) => panic!("the call must fail"),
        Err(error) => error,
    }
}

#[test]
fn a_failed_check() {
    judge_script(
        "whole",
        |b| b,
        512,
        |answer| {
            let error = failed(answer);
            assert!(matches!(error.cause(), Error::Check { .. }), "{error}");
        },
    );
}

#[test]
fn a_malformed_answer() {
    judge_script(
        "malformed",
        |b| b,
        256,
        |answer| {
            let error = failed(answer);
            assert!(matches!(error.cause(), Error::Malformed { .. }), "{error}");
        },
    );
}

#[test]
fn an_answer_cut_off() {
    judge_script(
        "cut",
        |b| b,
        256,
        |answer| {
            let error = failed(answer);
            assert!(matches!(error.cause(), Error::Interrupted { .. }), "{error}");
        },
    );
}

#[test]
fn a_timeout() {
    let settings = |builder: ClientBuilder| builder.timeout(Duration::from_millis(400));
    judge_script("drip", settings, 256, |answer| {
        let error = failed(answer);
        assert!(matches!(error.cause(), Error::Timeout { .. }), "{error}");
    });
}

#[test]
fn a_cancelled_call() {
    judge_script("drip", |b| b, 256, |answer| assert!(answer.is_none()));
}

#[test]
fn a_status_of_500_with_keys_in_its_body() {
    judge_script(
        "failing",
        |b| b,
        256,
        |answer| {
            assert_eq!(failed(answer).status_code(), Some(500));
        },
    );
}

#[test]
fn an_answer_in_chunks() {
    judge_script(
        "chunked",
        |b| b,
        256,
        |answer| {
            answer.expect("the call ends by itself").unwrap();
        },
    );
}

#[test]
fn success_with_keys_that_are_still_held() {
    let _turn = quarantine::turn();
    let kmes = Kmes::start();
    for number in [1, MANY as u32] {
        let enc = async |client: &Client| {
            client.enc_keys("sae-b").number(number).send().await.unwrap().keys
        };
        judge(&format!("enc_keys of {number}"), || kmes.simulated("sae-a"), enc, |k| exposed(k));
        // A KME gives them once: a batch for each of the two runs.
        let drawn = RefCell::new(Vec::new());
        let master = Runtime::new().unwrap();
        for _ in 0..2 {
            let batch = async { enc(&kmes.simulated("sae-a").build().unwrap()).await };
            drawn.borrow_mut().push(master.block_on(batch));
        }
        drop(master);
        let dec = async |client: &Client| {
            let batch = drawn.borrow_mut().pop().unwrap();
            let ids = batch.iter().map(Key::key_id);
            let same = client.dec_keys("sae-a").key_ids(ids).send().await.unwrap().keys;
            assert!(same == batch);
            same
        };
        judge(&format!("dec_keys of {number}"), || kmes.simulated("sae-b"), dec, |k| exposed(k));
    }
}
