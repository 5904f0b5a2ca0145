//! Simulated KMEs in a process of their own: the memory of a KME is full of keys, and grows with the keys that it
//! remembers.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};

use etsi_qkd014::sim::Network;
use etsi_qkd014::{Client, ClientBuilder, RetryPolicy};

/// The variable that makes the test binary run the KMEs, and that says where to write their certificates.
const VARIABLE: &str = "AXON_TEST_KMES";

/// The KMEs, which end with this.
pub(crate) struct Kmes {
    child: Child,
    _stdin: ChildStdin,
    dir: tempfile::TempDir,
    urls: Vec<String>,
}

impl Kmes {
    /// Starts them by the test `kmes` of this binary, which calls [`serve_if_asked`].
    pub(crate) fn start() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "kmes", "--nocapture"])
            .env(VARIABLE, dir.path())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let stdin = child.stdin.take().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let urls = lines
            .map_while(Result::ok)
            .find_map(|line| Some(line.split_once("KMEs: ")?.1.to_owned()))
            .expect("the child must say where its KMEs are");
        let urls = urls.split(' ').map(str::to_owned).collect();
        Self { child, _stdin: stdin, dir, urls }
    }

    /// Returns settings for the simulated KME of `sae`.
    pub(crate) fn simulated(&self, sae: &str) -> ClientBuilder {
        self.settings(sae, usize::from(sae == "sae-b"))
    }

    /// Returns settings of `sae` for a KME by its number: the simulated ones are 0 and 1.
    pub(crate) fn settings(&self, sae: &str, kme: usize) -> ClientBuilder {
        Client::builder()
            .kme_url(&self.urls[kme])
            .ca_file(self.file("ca.pem"))
            .sae_cert_file(self.file(&format!("{sae}.crt")))
            .sae_key_file(self.file(&format!("{sae}.key")))
            .retry(RetryPolicy::none())
    }

    /// Returns the path of a file that the KMEs wrote, such as `sae-a.key`.
    pub(crate) fn file(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }
}

impl Drop for Kmes {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// In the child: serves until standard input ends. Beside the simulated KMEs it serves the one that `another` starts
/// with the files in that directory, if any. Elsewhere: does nothing.
pub(crate) fn serve_if_asked(max_keys: u64, another: impl FnOnce(&Path) -> Option<String>) {
    let Some(dir) = std::env::var_os(VARIABLE).map(PathBuf::from) else { return };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let network = Network::builder()
        .strict()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
        .kme("kme-b", "127.0.0.1:0".parse().unwrap(), ["sae-b"])
        .max_keys_per_request(max_keys)
        .start();
    let network = runtime.block_on(network).unwrap();
    network.write_files(&dir).unwrap();
    let another = another(&dir);
    let urls = network.kmes().iter().map(|kme| kme.url()).chain(another.as_deref());
    let urls = urls.collect::<Vec<_>>().join(" ");
    std::io::stdout().write_all(format!("KMEs: {urls}\n").as_bytes()).unwrap();
    axon_tests::end_with_stdin();
}
