//! A file of the identity.

use std::path::{Path, PathBuf};

use crate::files::FileRules;
use axon_tls::identity::TrustFile;
use zeroize::Zeroizing;

use crate::error::GatewayError;
pub(super) use crate::files::FileStamp;

/// A file that a setting names.
#[derive(Clone, Debug)]
pub(super) struct NamedFile {
    pub(super) variable: &'static str,
    pub(super) path: PathBuf,
    demands: FileRules,
}

impl NamedFile {
    /// Names the file at `path`, if the setting is given.
    ///
    /// # Errors
    /// The setting is missing.
    pub(super) fn new(variable: &'static str, path: Option<&Path>) -> Result<Self, GatewayError> {
        let path = path.ok_or(GatewayError::Missing(variable))?.to_owned();
        let demands = match variable {
            "AXON_CLASSIC_KEY" => FileRules::KEY,
            "AXON_CLASSIC_TRUST" => FileRules::public(TrustFile::MAX_LEN as u64),
            _ => FileRules::CERTIFICATES,
        };
        Ok(Self { variable, path, demands })
    }

    /// Returns the failure of this file.
    pub(super) fn unusable(&self, reason: impl std::fmt::Display) -> GatewayError {
        GatewayError::File {
            variable: self.variable,
            path: self.path.clone(),
            reason: reason.to_string(),
        }
    }

    /// Returns the current stamp of the file, or the reason why its metadata makes it unusable.
    pub(super) fn stamp(&self) -> Result<FileStamp, String> {
        self.demands.stamp(&self.path)
    }

    /// Reads the whole file into a buffer that never moves and is erased.
    ///
    /// # Errors
    /// The file does not meet the requirements of the settings, cannot be read, or is too large.
    pub(super) fn read(&self) -> Result<Zeroizing<Vec<u8>>, GatewayError> {
        self.demands.read(&self.path).map_err(|reason| self.unusable(reason))
    }
}
