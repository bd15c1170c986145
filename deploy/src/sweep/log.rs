//! What the processes of a cell say, in a file beside the runs.

use rit_config::open_regular;
use rit_record::{Cell, Sweep};
use std::{
    fs::{DirBuilder, OpenOptions},
    io::{self, Write as _},
    os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _},
    path::Path,
};

/// Adds a line to a cell's log.
///
/// # Errors
/// When the disk refuses.
pub fn append(dir: &Path, cell: &Cell, line: &str) -> io::Result<()> {
    let path = Sweep::log(dir, cell);
    DirBuilder::new().recursive(true).mode(0o700).create(path.parent().unwrap_or(dir))?;
    let mut file = open_regular(&path, OpenOptions::new().create(true).append(true).mode(0o600))?;
    file.write_all(format!("{line}\n").as_bytes())
}
