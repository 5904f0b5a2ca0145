//! The blocking client.

use etsi_qkd014::sim::Network;
use etsi_qkd014::{Error, blocking};

fn network(runtime: &tokio::runtime::Runtime) -> Network {
    let start = Network::builder()
        .strict()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
        .kme("kme-b", "127.0.0.2:0".parse().unwrap(), ["sae-b"])
        .start();
    runtime.block_on(start).unwrap()
}

#[test]
fn inside_a_runtime_it_is_refused_and_may_be_dropped() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let network = network(&runtime);
    let client = blocking::Client::new(network.client_builder("sae-a")).unwrap();
    runtime.block_on(async move {
        let error = client.status("sae-b").unwrap_err();
        assert!(matches!(error, Error::Request { .. }), "{error}");
        drop(client);
    });
}

#[test]
fn it_needs_no_runtime_of_the_caller() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let network = network(&runtime);
    let master = blocking::Client::new(network.client_builder("sae-a")).unwrap();
    let slave = blocking::Client::new(network.client_builder("sae-b")).unwrap();
    let drawn = master.enc_keys("sae-b", |request| request.number(3).size(128)).unwrap().keys;
    let same = std::thread::scope(|scope| {
        let ids = drawn.iter().map(|key| key.key_id());
        scope.spawn(|| slave.clone().dec_keys("sae-a", |request| request.key_ids(ids))).join()
    });
    assert!(same.unwrap().unwrap().keys == drawn);
    assert_eq!(master.status("sae-b").unwrap().key_size, 256);
}
