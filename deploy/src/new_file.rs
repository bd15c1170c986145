//! Files that commands make for people: whole or not at all, and over nothing unless that is asked for.

use crate::failure::Failure;
use std::{
    fs::Permissions,
    io::{self, Write as _},
    os::unix::fs::PermissionsExt as _,
    path::Path,
};

/// Refuses a file that is there already, unless it may be written over. Asked before the work of making its content.
///
/// # Errors
/// When it is there.
pub fn check(path: &Path, force: bool) -> Result<(), Failure> {
    // A dangling link is there too: moving a file onto it would replace it.
    if path.symlink_metadata().is_ok() && !force { Err(occupied(path)) } else { Ok(()) }
}

/// Writes the file beside its place and moves it there.
///
/// # Errors
/// When it is there and may not be written over, or cannot be written.
pub fn write(path: &Path, bytes: &[u8], force: bool) -> Result<(), Failure> {
    let wrong = |error: io::Error| {
        if error.kind() == io::ErrorKind::AlreadyExists {
            occupied(path)
        } else {
            Failure::input_message(format!("--out {}: {error}", path.display()))
        }
    };
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let readable = Permissions::from_mode(0o666); // less what the umask takes
    let mut partial = tempfile::Builder::new().permissions(readable).tempfile_in(folder).map_err(wrong)?;
    partial.write_all(bytes).map_err(wrong)?;
    // Not there when looked for, but meanwhile it may be.
    let moved = if force { partial.persist(path) } else { partial.persist_noclobber(path) };
    moved.map(drop).map_err(|error| wrong(error.error))
}

fn occupied(path: &Path) -> Failure {
    Failure::input_message(format!("{} is there already; --force writes over it", path.display()))
}
