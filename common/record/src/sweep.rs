//! A sweep: runs that are compared with each other, in one folder.
//!
//! `sweep.json` says which; the run of each cell lies in `runs/NAME`, and what its processes said in `logs/NAME.log`: its
//! end is all that a cell leaves which fails before it begins.

use crate::{Ended, RecordError, Summary, discover::is_run};
use rit_config::RunDir;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::{
    collections::BTreeMap,
    io::{ErrorKind, Write as _},
    path::{Path, PathBuf},
};
use tempfile::NamedTempFile;

/// The manifest's name.
const MANIFEST: &str = "sweep.json";
/// What this build writes. Raise it when a key's meaning changes.
const FORMAT_VERSION: u32 = 1;
/// No manifest is longer.
const BYTES_MAX: u64 = 64 << 20;
/// Of a log's end, what is looked at for its last words, in bytes.
const LAST_WORDS: u64 = 8 << 10;

/// The runs of a sweep.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sweep {
    format_version: u32,
    /// Keys that cells differ in, beside the seed.
    pub axes: Vec<String>,
    /// The runs, in the order they are begun in.
    pub cells: Vec<Cell>,
    /// What this build does not know.
    #[serde(flatten)]
    other: Map<String, Value>,
}

/// One run of a sweep.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cell {
    /// Its folder's name under `runs/`, which says what sets it apart.
    pub name: String,
    /// The experiment that it begins from: a name, or a file's path.
    pub experiment: String,
    /// Its seed.
    pub seed: u64,
    /// What it sets beyond the experiment, by key: values as TOML has them.
    pub settings: BTreeMap<String, String>,
}

/// How a cell stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CellState {
    /// Nothing is there of it yet.
    Waiting,
    /// It has begun and not ended: it runs, or was killed.
    Begun,
    /// It has ended, as this.
    Ended(Ended),
}

impl Sweep {
    /// Of these cells.
    pub fn new(axes: Vec<String>, cells: Vec<Cell>) -> Self {
        Self { format_version: FORMAT_VERSION, axes, cells, other: Map::new() }
    }

    /// The sweep of a folder; nothing if it holds none.
    ///
    /// # Errors
    /// When the manifest cannot be read, or is of another format.
    pub fn read(dir: &Path) -> Result<Option<Self>, RecordError> {
        let path = dir.join(MANIFEST);
        let text = match rit_config::read_regular(&path, BYTES_MAX) {
            Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
                return Ok(None);
            }
            text => text.map_err(RecordError::io(&path))?,
        };
        let other = |why: String| RecordError::Other { path: path.clone(), what: "manifest of a sweep", why };
        let sweep: Self = serde_json::from_slice(&text).map_err(|error| other(error.to_string()))?;
        if sweep.format_version != FORMAT_VERSION {
            let (found, known) = (sweep.format_version, FORMAT_VERSION);
            return Err(RecordError::Format { path, found, known });
        }
        let is_name = |name: &str| !name.is_empty() && !name.contains('/') && name != "." && name != "..";
        if let Some(cell) = sweep.cells.iter().find(|cell| !is_name(&cell.name)) {
            return Err(other(format!("a cell is called {:?}, which is no folder's name", cell.name)));
        }
        Ok(Some(sweep))
    }

    /// Writes the manifest, as a whole or not at all.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn write(&self, dir: &Path) -> Result<(), RecordError> {
        let path = dir.join(MANIFEST);
        // Several hosts may do so at once, each for a cell of its own.
        let written = NamedTempFile::new_in(dir).and_then(|mut partial| {
            partial.write_all(&serde_json::to_vec_pretty(self)?)?;
            partial.persist(&path).map_err(|error| error.error)
        });
        written.map(drop).map_err(RecordError::io(&path))
    }

    /// Where the run of a cell lies.
    pub fn run_dir(dir: &Path, cell: &Cell) -> PathBuf {
        dir.join("runs").join(&cell.name)
    }

    /// How a command's log says that it failed.
    pub const ERROR: &str = "error: ";

    /// Where a cell's log lies.
    pub fn log(dir: &Path, cell: &Cell) -> PathBuf {
        dir.join("logs").join(format!("{}.log", cell.name))
    }

    /// The last line of a cell's log, if it has one.
    pub fn last_words(dir: &Path, cell: &Cell) -> Option<String> {
        let tail = rit_config::read_tail(&Self::log(dir, cell), 0, LAST_WORDS).ok()?;
        tail.lines().rev().find(|line| !line.trim().is_empty()).map(|line| line.trim().to_owned())
    }

    /// Why a cell of which there is no run failed; nothing of one that was not tried.
    pub fn failure(dir: &Path, cell: &Cell) -> Option<String> {
        let words = Self::last_words(dir, cell)?;
        words.strip_prefix(Self::ERROR).map(str::to_owned)
    }

    /// How a cell stands.
    pub fn state(dir: &Path, cell: &Cell) -> CellState {
        let root = Self::run_dir(dir, cell);
        if !is_run(&root) {
            return CellState::Waiting;
        }
        let summary = RunDir::open(&root).ok().and_then(|(run_dir, _)| Summary::read(&run_dir).ok()?);
        summary.map_or(CellState::Begun, |summary| CellState::Ended(summary.ended))
    }
}
