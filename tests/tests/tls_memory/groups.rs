//! The key exchange group of AXON, in a form that reveals the shared secret of each key exchange.

use std::sync::{Arc, Mutex};

/// The result of the last key exchange.
pub(crate) type Told = Arc<Mutex<Vec<u8>>>;

/// A group that reveals the shared secret, in the types of one of the two rustls.
macro_rules! tapped_group {
    ($name:ident, $tls:ident) => {
        pub(crate) mod $name {
            use $tls::crypto::{
                ActiveKeyExchange, CompletedKeyExchange, SharedSecret, SupportedKxGroup,
                aws_lc_rs::kx_group::X25519MLKEM768,
            };
            use $tls::{Error, NamedGroup};

            #[derive(Debug)]
            pub(crate) struct Group(pub(crate) super::Told);

            struct Active(Box<dyn ActiveKeyExchange>, super::Told);

            fn tell(told: &super::Told, secret: &SharedSecret) {
                *told.lock().unwrap() = secret.secret_bytes().to_vec();
            }

            impl SupportedKxGroup for Group {
                fn start(&self) -> Result<Box<dyn ActiveKeyExchange>, Error> {
                    Ok(Box::new(Active(X25519MLKEM768.start()?, self.0.clone())))
                }

                fn start_and_complete(&self, peer: &[u8]) -> Result<CompletedKeyExchange, Error> {
                    let completed = X25519MLKEM768.start_and_complete(peer)?;
                    tell(&self.0, &completed.secret);
                    Ok(completed)
                }

                fn name(&self) -> NamedGroup {
                    X25519MLKEM768.name()
                }
            }

            impl ActiveKeyExchange for Active {
                fn complete(self: Box<Self>, peer: &[u8]) -> Result<SharedSecret, Error> {
                    let secret = self.0.complete(peer)?;
                    tell(&self.1, &secret);
                    Ok(secret)
                }

                fn pub_key(&self) -> &[u8] {
                    self.0.pub_key()
                }

                fn group(&self) -> NamedGroup {
                    self.0.group()
                }
            }
        }
    };
}

tapped_group!(of_axon, rustls_axon);
tapped_group!(of_rustls, rustls);
