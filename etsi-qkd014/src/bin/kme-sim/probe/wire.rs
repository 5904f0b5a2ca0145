//! Raw requests and answers.

use reqwest::{Method, Url};
use rustls::ClientConfig;
use serde_json::Value;
use zeroize::Zeroizing;

use super::party::Party;
use crate::{CommandResult, other};

/// Largest answer that is read, in bytes.
const MAX_BODY: usize = 1 << 20;

pub(super) struct Wire {
    http: reqwest::Client,
}

/// An answer.
pub(super) struct Raw {
    pub(super) status: u16,
    pub(super) version: String,
    pub(super) media: Option<String>,
    /// May contain keys that were not requested, so it is zeroized.
    pub(super) body: Zeroizing<Vec<u8>>,
}

impl Raw {
    pub(super) fn json(&self) -> Option<Value> {
        serde_json::from_slice(&self.body).ok()
    }

    /// Returns the `message` of an error (clause 6.5).
    pub(super) fn message(&self) -> Option<String> {
        Some(self.json()?.get("message")?.as_str()?.to_owned())
    }

    /// Returns the status with the message of an error, for the table.
    pub(super) fn summary(&self) -> String {
        match self.message().filter(|_| self.status != 200) {
            Some(message) => format!("{} {message:?}", self.status),
            None => self.status.to_string(),
        }
    }
}

impl Wire {
    pub(super) fn new(party: &Party, tls: ClientConfig) -> CommandResult<Self> {
        let http = reqwest::Client::builder()
            .tls_backend_preconfigured(tls)
            .https_only(true)
            .http1_only()
            .no_proxy()
            .redirect(reqwest::redirect::Policy::none())
            .retry(reqwest::retry::never())
            .timeout(party.timeout)
            // Each request uses its own connection, so that a fault affects only one check.
            .pool_max_idle_per_host(0)
            .build()
            .map_err(other)?;
        Ok(Self { http })
    }

    pub(super) async fn get(&self, url: Url) -> Result<Raw, String> {
        self.send(Method::GET, url, None).await
    }

    pub(super) async fn post(&self, url: Url, body: String) -> Result<Raw, String> {
        self.send(Method::POST, url, Some(body)).await
    }

    async fn send(&self, method: Method, url: Url, body: Option<String>) -> Result<Raw, String> {
        let mut request = self.http.request(method, url);
        if let Some(body) = body {
            request = request.header("content-type", "application/json").body(body);
        }
        let mut answer = request.send().await.map_err(|e| innermost(&e))?;
        let media = answer.headers().get("content-type");
        let media = media.and_then(|value| value.to_str().ok()).map(str::to_owned);
        let (status, version) = (answer.status().as_u16(), format!("{:?}", answer.version()));
        let mut body = Zeroizing::new(Vec::with_capacity(64 << 10));
        while let Some(chunk) = answer.chunk().await.map_err(|e| innermost(&e))? {
            if body.len() + chunk.len() > MAX_BODY {
                return Err(format!("an answer of more than {MAX_BODY} bytes"));
            }
            body.extend_from_slice(&chunk);
        }
        Ok(Raw { status, version, media, body })
    }
}

/// Returns the innermost reason, below the texts of the libraries.
fn innermost(error: &reqwest::Error) -> String {
    let mut error: &dyn std::error::Error = error;
    while let Some(source) = error.source() {
        error = source;
    }
    error.to_string()
}
