//! Two SAEs get the same key, each from its own KME. The KMEs are simulated.
//!
//! ```sh
//! cargo run -p etsi-qkd014 --example two_saes --features sim
//! ```
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

use std::error::Error;

use etsi_qkd014::secrecy::ExposeSecret;
use etsi_qkd014::sim::Network;

#[tokio::main]
async fn main() -> Result<(), Box<dyn Error>> {
    let network = Network::builder()
        .kme("kme-a", "127.0.0.1:0".parse()?, ["sae-a"])
        .kme("kme-b", "127.0.0.1:0".parse()?, ["sae-b"])
        .strict()
        .start()
        .await?;
    // With real KMEs: `Client::builder()`, with the URL and the files that the KME's operator gives.
    let master = network.client_builder("sae-a").build()?;
    let slave = network.client_builder("sae-b").build()?;

    let status = master.status("sae-b").await?;
    println!("{} has {} keys for sae-b", status.source_kme_id, status.stored_key_count);

    let drawn = master.enc_keys("sae-b").size(256).send().await?.into_single();
    println!("sae-a drew {}", drawn.key_id());

    // The key_ID is no secret, and gets to the slave by any means.
    let same = slave.dec_keys("sae-a").key_id(drawn.key_id()).send().await?.into_single();
    if drawn != same {
        return Err("the KMEs gave two keys under one key_ID".into());
    }
    println!("sae-b has the same {} bytes", same.expose_secret().len());

    // A KME gives each key once.
    match slave.dec_keys("sae-a").key_id(drawn.key_id()).send().await {
        Ok(_) => Err("the key was given twice".into()),
        Err(refused) => {
            println!("and nobody gets it again: {refused}");
            Ok(())
        }
    }
}
