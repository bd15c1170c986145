//! What the processes of a cell say, in a file beside the runs: its end is all that a cell leaves which fails before it
//! begins.

use rit_config::{open_regular, read_regular};
use rit_record::Cell;
use std::{
    fs::{DirBuilder, OpenOptions},
    io::{self, Write as _},
    os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _},
    path::{Path, PathBuf},
};

/// How a command says that it failed.
pub const ERROR: &str = "error: ";

/// No log of a cell is longer.
const BYTES_MAX: u64 = 1 << 32;

/// Of a log's end, what is looked at for its last words, in bytes.
const LAST_WORDS: usize = 8 << 10;

/// Where a cell's log lies.
pub fn path(dir: &Path, cell: &Cell) -> PathBuf {
    dir.join("logs").join(format!("{}.log", cell.name))
}

/// The last line of a cell's log, if it has one.
pub fn last_words(dir: &Path, cell: &Cell) -> Option<String> {
    let text = read_regular(&path(dir, cell), BYTES_MAX).ok()?;
    let tail = String::from_utf8_lossy(&text[text.len().saturating_sub(LAST_WORDS)..]).into_owned();
    tail.lines().rev().find(|line| !line.trim().is_empty()).map(|line| line.trim().to_owned())
}

/// Adds a line to a cell's log.
///
/// # Errors
/// When the disk refuses.
pub fn append(dir: &Path, cell: &Cell, line: &str) -> io::Result<()> {
    let path = path(dir, cell);
    DirBuilder::new().recursive(true).mode(0o700).create(path.parent().unwrap_or(dir))?;
    let mut file = open_regular(&path, OpenOptions::new().create(true).append(true).mode(0o600))?;
    file.write_all(format!("{line}\n").as_bytes())
}
