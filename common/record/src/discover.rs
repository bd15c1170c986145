//! Which runs there are.

use crate::{RecordError, is_header};
use std::{
    collections::BTreeSet,
    fs::{self, OpenOptions},
    io::{ErrorKind, Read as _},
    path::{Path, PathBuf},
};

/// Folders lie within each other no deeper than this, or they are not looked into.
const DEPTH_MAX: usize = 12;

/// Every run under these paths, each once: run directories and committed records. A path that is one is itself; a folder is
/// searched, but for links in it.
///
/// # Errors
/// When a path is not there or holds no run.
pub fn discover(paths: &[PathBuf]) -> Result<Vec<PathBuf>, RecordError> {
    let (mut found, mut seen) = (Vec::new(), BTreeSet::new());
    for path in paths {
        let mut here = Vec::new();
        if is_run(path) || path.is_file() {
            here.push(path.clone());
        } else {
            search(path, 0, &mut here)?;
        }
        if here.is_empty() {
            return Err(RecordError::None(path.clone()));
        }
        for run in here {
            if seen.insert(run.canonicalize().map_err(RecordError::io(&run))?) {
                found.push(run);
            }
        }
    }
    Ok(found)
}

/// Whether a folder is a run directory.
pub(crate) fn is_run(folder: &Path) -> bool {
    folder.join("config.toml").is_file() && folder.join("run_id").is_file()
}

fn search(folder: &Path, depth: usize, found: &mut Vec<PathBuf>) -> Result<(), RecordError> {
    let entries = fs::read_dir(folder).map_err(RecordError::io(folder))?;
    let mut entries: Vec<_> = entries.collect::<Result<_, _>>().map_err(RecordError::io(folder))?;
    entries.sort_by_key(fs::DirEntry::file_name);
    for entry in entries {
        let (path, kind) = (entry.path(), entry.file_type());
        let Ok(kind) = kind else { continue };
        if kind.is_dir() && is_run(&path) {
            found.push(path);
        } else if kind.is_dir() && depth < DEPTH_MAX {
            match search(&path, depth + 1, found) {
                // One that may not be looked into holds no runs of this user's.
                Err(RecordError::Io { error, .. }) if error.kind() == ErrorKind::PermissionDenied => {}
                searched => searched?,
            }
        } else if kind.is_file() && path.extension().is_some_and(|it| it == "jsonl") && is_metrics(&path) {
            found.push(path);
        }
    }
    Ok(())
}

/// Whether a file begins as a metrics file does.
fn is_metrics(path: &Path) -> bool {
    let mut bytes = Vec::new();
    let opened = rit_config::open_regular(path, OpenOptions::new().read(true));
    let begins = opened.and_then(|file| file.take(64).read_to_end(&mut bytes));
    begins.is_ok() && (is_header(&bytes) || bytes.starts_with(br#"{"kind":"#))
}
