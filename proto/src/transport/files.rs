//! Files with secrets and certificates. A secret that others can read is none.

use rustix::fs::{Mode, OFlags};
use std::{
    fs::{File, Metadata},
    io::{self, Read as _},
    os::unix::fs::{MetadataExt as _, PermissionsExt as _},
    path::{Path, PathBuf},
};
use tokio_rustls::rustls::{
    RootCertStore,
    pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject as _},
};

/// Fewer characters than this are guessed.
const TOKEN_LENGTH_MIN: usize = 16;

/// No file of these is longer.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// A file that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// Group or others can read or write it.
    #[error("{path} can be read by others (mode {mode:o}); run `chmod 600 {path}`")]
    ReadByOthers {
        /// The file.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// It belongs to another user.
    #[error("{0} belongs to another user; have one of your own")]
    OthersFile(PathBuf),
    /// Too short, or with characters that cannot be sent.
    #[error(
        "{0} holds no token of at least {TOKEN_LENGTH_MIN} letters and digits; `openssl rand -hex 32` makes one"
    )]
    NoToken(PathBuf),
    /// A pipe, a device or a folder.
    #[error("{0} is no regular file")]
    NotRegular(PathBuf),
    /// Not what it should be.
    #[error("{path} holds no {what} in PEM form")]
    NotPem {
        /// The file.
        path: PathBuf,
        /// What it should hold.
        what: &'static str,
    },
    /// The system refused.
    #[error("{path}: {error}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
}

/// Whether a file is this user's, and other users cannot read it.
///
/// # Errors
/// When it is not.
pub fn check_private(path: &Path, metadata: &Metadata) -> Result<(), FileError> {
    let mode = metadata.permissions().mode() & 0o7777;
    if mode & 0o077 != 0 {
        return Err(FileError::ReadByOthers { path: path.to_owned(), mode });
    }
    let me = rustix::process::geteuid().as_raw();
    if metadata.uid() != me && metadata.uid() != 0 {
        return Err(FileError::OthersFile(path.to_owned()));
    }
    Ok(())
}

fn read(path: &Path, check: impl FnOnce(&Metadata) -> Result<(), FileError>) -> Result<Vec<u8>, FileError> {
    let io = |error| FileError::Io { path: path.to_owned(), error };
    // What is looked at is what is read: the open file, not its name. A pipe without a writer opens at once.
    let file = rustix::fs::open(path, OFlags::RDONLY | OFlags::NONBLOCK | OFlags::CLOEXEC, Mode::empty());
    let file = File::from(file.map_err(|error| io(error.into()))?);
    let metadata = file.metadata().map_err(io)?;
    if !metadata.is_file() {
        return Err(FileError::NotRegular(path.to_owned()));
    }
    check(&metadata)?;
    let mut bytes = Vec::new();
    file.take(FILE_BYTES_MAX).read_to_end(&mut bytes).map_err(io)?;
    Ok(bytes)
}

fn read_private(path: &Path) -> Result<Vec<u8>, FileError> {
    read(path, |metadata| check_private(path, metadata))
}

/// The token in a file of this user alone, without the white space around it.
pub(super) fn read_token(path: &Path) -> Result<String, FileError> {
    let token = String::from_utf8(read_private(path)?).unwrap_or_default().trim().to_owned();
    if token.len() < TOKEN_LENGTH_MIN || !token.bytes().all(|byte| byte.is_ascii_graphic()) {
        return Err(FileError::NoToken(path.to_owned()));
    }
    Ok(token)
}

/// A certificate and those that lead to its authority.
pub(super) fn read_certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, FileError> {
    let pem = read(path, |_| Ok(()))?;
    let certificates: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&pem).collect();
    match certificates {
        Ok(certificates) if !certificates.is_empty() => Ok(certificates),
        _ => Err(FileError::NotPem { path: path.to_owned(), what: "certificate" }),
    }
}

/// A private key in a file of this user alone.
pub(super) fn read_key(path: &Path) -> Result<PrivateKeyDer<'static>, FileError> {
    let not_pem = |_| FileError::NotPem { path: path.to_owned(), what: "private key" };
    PrivateKeyDer::from_pem_slice(&read_private(path)?).map_err(not_pem)
}

/// The certificates of authorities.
pub(super) fn read_authorities(path: &Path) -> Result<RootCertStore, FileError> {
    let mut authorities = RootCertStore::empty();
    for certificate in read_certificates(path)? {
        let not_pem = |_| FileError::NotPem { path: path.to_owned(), what: "authority's certificate" };
        authorities.add(certificate).map_err(not_pem)?;
    }
    Ok(authorities)
}
