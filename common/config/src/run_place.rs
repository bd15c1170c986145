//! Where a run was made: what tells a copied run directory from one that was moved.

use crate::{RunDirError, read_text, write_whole};
use std::{
    fs, io,
    os::unix::fs::MetadataExt as _,
    path::{Path, PathBuf},
};

/// The file that says so: device and number, then the path.
pub(crate) const PLACE: &str = "place";

/// A directory as the system knows it, and as people do.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Place {
    /// Device and number on it: they stay when the directory is renamed.
    identity: (u64, u64),
    path: PathBuf,
}

/// How a run's directory came to be where it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Came {
    /// It was made here.
    MadeHere,
    /// It was made elsewhere, and is there no longer.
    Moved,
    /// The run that it was made of is still there.
    CopiedFrom(PathBuf),
}

/// How the run with this `run_id` file came to be in `root`, which is canonical.
///
/// # Errors
/// When the directory cannot be read.
pub(crate) fn came(root: &Path, run_id_file: &str) -> Result<Came, RunDirError> {
    let here = Place::of(root).map_err(|error| RunDirError::Io { path: root.to_owned(), error })?;
    let Some(made) = Place::read(root) else { return Ok(Came::MadeHere) };
    if made == here {
        return Ok(Came::MadeHere);
    }
    // Renamed; or brought back by a backup, or on a device that has another number since the machine started.
    if made.identity == here.identity || made.path == here.path {
        return Ok(Came::Moved);
    }
    let there = Place::of(&made.path).ok().filter(|there| there.identity != here.identity);
    let run_id = |root: &Path| read_text(&root.join(run_id_file)).ok();
    if there.is_some() && run_id(&made.path).is_some_and(|theirs| Some(theirs) == run_id(root)) {
        return Ok(Came::CopiedFrom(made.path));
    }
    Ok(Came::Moved)
}

/// Writes down that the run was made here.
///
/// # Errors
/// When it cannot be written.
pub(crate) fn write(root: &Path) -> io::Result<()> {
    let Place { identity: (device, inode), path } = Place::of(root)?;
    write_whole(&root.join(PLACE), format!("{device}:{inode}\n{}\n", path.display()).as_bytes())
}

impl Place {
    fn of(root: &Path) -> io::Result<Self> {
        let metadata = fs::metadata(root)?;
        Ok(Self { identity: (metadata.dev(), metadata.ino()), path: root.to_owned() })
    }

    /// Nothing where a run does not say it: then it was made before runs did.
    fn read(root: &Path) -> Option<Self> {
        let text = read_text(&root.join(PLACE)).ok()?;
        let (identity, path) = text.split_once('\n')?;
        let (device, inode) = identity.split_once(':')?;
        let path = PathBuf::from(path.strip_suffix('\n').unwrap_or(path));
        Some(Self { identity: (device.parse().ok()?, inode.parse().ok()?), path })
    }
}
