//! Faults changed while the simulator runs: over real sockets, and with the binary as a user does.

mod program;

use std::io::{BufRead, BufReader};
use std::net::{SocketAddr, TcpListener};
use std::process::Stdio;
use std::sync::Arc;

use etsi_qkd014::sim::{Control, Network};
use program::{Killed, kme_sim};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

async fn network() -> (Arc<Network>, SocketAddr) {
    let any = "127.0.0.1:0".parse().unwrap();
    let builder =
        Network::builder().strict().kme("kme-a", any, ["sae-a"]).kme("kme-b", any, ["sae-b"]);
    let network = Arc::new(builder.start().await.unwrap());
    let control = Control::bind(any).await.unwrap();
    let addr = control.addr();
    tokio::spawn(control.serve(Arc::clone(&network)));
    (network, addr)
}

/// Sends `request` as it stands; the answer's status and body.
async fn send(addr: SocketAddr, request: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(addr).await.unwrap();
    stream.write_all(request.as_bytes()).await.unwrap();
    stream.shutdown().await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap_or_default();
    let status = head.split(' ').nth(1).and_then(|code| code.parse().ok()).unwrap_or(0);
    (status, body.to_owned())
}

fn request(addr: SocketAddr, first: &str, body: &str) -> String {
    format!(
        "{first} HTTP/1.1\r\nHost: {addr}\r\nX-Kme-Sim: 1\r\nContent-Type: application/json\r\n\
         Content-Length: {}\r\n\r\n{body}",
        body.len()
    )
}

#[tokio::test]
async fn it_listens_on_loopback_only() {
    for bind in ["0.0.0.0:0", "[::]:0", "192.0.2.1:8400"] {
        let error = Control::bind(bind.parse().unwrap()).await.unwrap_err();
        assert!(error.to_string().contains("loopback"), "{error}");
    }
}

#[tokio::test]
async fn requests_that_a_web_page_could_send_are_refused() {
    let (network, addr) = network().await;
    let good = request(addr, "PUT /faults/kme-a", r#"["cut"]"#);
    let host = format!("Host: {addr}");
    let port = addr.port();
    for (why, bad) in [
        ("rebound name", good.replace(&host, &format!("Host: evil.example:{port}"))),
        ("localhost", good.replace(&host, &format!("Host: localhost:{port}"))),
        ("no host", good.replace(&format!("{host}\r\n"), "")),
        ("no header", good.replace("X-Kme-Sim: 1\r\n", "")),
        ("other header", good.replace("X-Kme-Sim: 1", "X-Kme-Sim: 0")),
        ("a form", good.replace("application/json", "text/plain")),
        ("no media type", good.replace("Content-Type: application/json\r\n", "")),
        ("origin", good.replace("X-Kme", "Origin: http://evil.example\r\nX-Kme")),
        ("null origin", good.replace("X-Kme", "Origin: null\r\nX-Kme")),
        ("reading", format!("GET /faults HTTP/1.1\r\n{host}\r\n\r\n")),
        (
            "preflight",
            format!("OPTIONS /faults/kme-a HTTP/1.1\r\n{host}\r\nOrigin: http://e\r\n\r\n"),
        ),
    ] {
        let (status, body) = send(addr, &bad).await;
        assert_eq!(status, 403, "{why}: {body}");
        assert!(!body.contains("kme-a"), "{why}: {body}");
    }
    assert!(network.kme("kme-a").unwrap().plans().is_empty());
    assert_eq!(send(addr, &good).await, (200, r#"["cut"]"#.to_owned()));
}

#[tokio::test]
async fn hostile_requests_change_nothing() {
    let (network, addr) = network().await;
    let kme = network.kme("kme-a").unwrap();
    kme.plan("garbage".parse().unwrap());
    let many = format!("[{}]", vec!["\"cut\""; 257].join(","));
    let put = |body: &str| request(addr, "PUT /faults/kme-a", body);
    let long = put("[]").replace("Content-Length: 2", "Content-Length: 99999999999999999");
    for (expected, bad) in [
        (400, put("")),
        (400, put("{}")),
        (400, put("[1]")),
        (400, put(r#"["cut","nonsense"]"#)),
        (400, put(r#"["cut,times=0"]"#)),
        (400, put(&"[".repeat(50_000))),
        (400, put(&many)),
        (413, put(&" ".repeat(70_000))),
        (413, long),
        (431, format!("GET /faults HTTP/1.1\r\nX: {}", "x".repeat(20_000))),
        (400, "\0\0\0\0\r\n\r\n".to_owned()),
        (404, request(addr, "PUT /faults/kme-x", "[]")),
        (404, request(addr, "PUT /faults/../kmes", "[]")),
        (405, request(addr, "PUT /kmes", "[]")),
        (405, request(addr, "PATCH /faults/kme-a", "[]")),
    ] {
        let (status, body) = send(addr, &bad).await;
        assert_eq!(status, expected, "{}: {body}", &bad[..bad.len().min(80)]);
    }
    assert_eq!(kme.plans(), ["garbage".parse().unwrap()]);
}

#[tokio::test]
async fn faults_are_set_added_listed_and_cleared_and_met() {
    let (network, addr) = network().await;
    let call = async |first: &str, body: &str| send(addr, &request(addr, first, body)).await;
    let client = network.client_builder("sae-a").retry(etsi_qkd014::RetryPolicy::none());
    let client = client.build().unwrap();

    assert_eq!(call("PUT /faults/kme-a", r#"["status=500,times=1"]"#).await.0, 200);
    let (_, both) = call("POST /faults/kme-a", r#"["garbage,on=status"]"#).await;
    assert_eq!(both, r#"["status=500,times=1","garbage,on=status"]"#);
    let (_, all) = call("GET /faults", "").await;
    assert!(all.contains("\"kme-b\":[]") && all.contains(&both), "{all}");
    assert_eq!(client.status("sae-b").await.unwrap_err().status_code(), Some(500));
    assert!(client.status("sae-b").await.unwrap_err().to_string().contains("malformed"));
    assert_eq!(call("DELETE /faults/kme-a", "").await, (200, "[]".to_owned()));
    client.status("sae-b").await.unwrap();
    let (_, kmes) = call("GET /kmes", "").await;
    assert!(kmes.contains("\"status_calls\":3") && kmes.contains(network.kmes()[1].url()));
}

#[tokio::test]
async fn a_certificate_expires_and_is_renewed_at_run_time() {
    let (network, addr) = network().await;
    let status = async || {
        // A connection that is open already would not be met.
        let client = network.client_builder("sae-a").retry(etsi_qkd014::RetryPolicy::none());
        client.build().unwrap().status("sae-b").await.map(drop).map_err(|error| error.to_string())
    };
    for (plan, said) in [
        ("certificate-expired", "the KME's certificate has expired"),
        ("certificate-not-yet-valid", "the KME's certificate is not valid yet"),
    ] {
        let set = request(addr, "PUT /faults/kme-a", &format!("[\"{plan}\"]"));
        assert_eq!(send(addr, &set).await, (200, format!("[\"{plan}\"]")));
        for _ in 0..2 {
            let error = status().await.unwrap_err();
            assert!(error.contains(said), "{error}");
        }
        assert_eq!(send(addr, &request(addr, "DELETE /faults/kme-a", "")).await.0, 200);
        status().await.unwrap();
        let on = request(addr, "PUT /faults/kme-a", &format!("[\"{plan},on=status\"]"));
        assert_eq!(send(addr, &on).await.0, 400, "it meets connections, not methods");
    }
}

#[test]
fn the_command_line_changes_the_faults_of_a_run() {
    let dir = tempfile::tempdir().unwrap();
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let site = format!("kme-a=127.0.0.1:{port}=sae-a,sae-b");
    let made = kme_sim().arg("init").arg(dir.path()).args(["--kme", &site]).output().unwrap();
    assert!(made.status.success());
    let refused = kme_sim().arg("run").arg(dir.path()).args(["--control", "0.0.0.0:0"]).output();
    let refused = refused.unwrap();
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("loopback"));

    let mut run = kme_sim();
    run.arg("run").arg(dir.path()).args(["--control", "127.0.0.1:0"]).stdout(Stdio::piped());
    let mut run = Killed(run.spawn().unwrap());
    let mut lines = BufReader::new(run.0.stdout.take().unwrap()).lines();
    lines.next().unwrap().unwrap();
    let line = lines.next().unwrap().unwrap();
    let address = line.strip_prefix("control http://").unwrap();

    let fault = |args: &[&str]| {
        let output = kme_sim().args(["fault", "--control", address]).args(args).output().unwrap();
        let text = [output.stdout, output.stderr].concat();
        (output.status.code().unwrap(), String::from_utf8(text).unwrap())
    };
    assert_eq!(fault(&["set", "kme-a", "nonsense"]).0, 2);
    assert_eq!(fault(&["set", "kme-a"]).0, 2);
    assert_eq!(fault(&["set", "a b", "cut"]).0, 2);
    let (code, text) = fault(&["clear", "kme-x"]);
    assert!(code == 1 && text.contains("no KME"), "{text}");
    assert_eq!(fault(&["add", "kme-a", "cut", "latency=5"]).0, 0);
    assert_eq!(fault(&["add", "kme-a", "reset,times=2"]).0, 0);
    let (_, text) = fault(&["list"]);
    assert!(["\"cut\"", "\"latency=5\"", "\"reset,times=2\""].iter().all(|p| text.contains(p)));
    assert_eq!(fault(&["set", "kme-a", "empty"]).1, "[\n  \"empty\"\n]\n");
    assert_eq!(fault(&["clear", "kme-a"]), (0, "[]\n".to_owned()));
    assert!(fault(&["kmes"]).1.contains("\"dec_keys_calls\": 0"));
    drop(run);
    assert_eq!(fault(&["list"]).0, 1, "nobody listens any more");
}
