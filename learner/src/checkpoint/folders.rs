//! The folders of checkpoints: their names, and which of them there are.
//!
//! `step-000000000400` is the checkpoint at 400 environment steps; `step-000000000400-2` is a later one at the same
//! step. A name is never used while another folder has it, so at no moment is a checkpoint taken away before its
//! successor lies there.

use super::{CheckpointError, FILE_BYTES_MAX, MANIFEST, Manifest, io};
use crate::damaged;
use std::{
    fs,
    io::ErrorKind,
    path::{Path, PathBuf},
};

/// What a folder is called while it is written.
pub(super) const PARTIAL: &str = "partial";

/// A folder called like a checkpoint.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Folder {
    /// Environment steps, as its name says.
    pub env_steps: u64,
    /// Which one at that step, from 1.
    pub repetition: u64,
    pub path: PathBuf,
}

impl Folder {
    fn parse(path: PathBuf) -> Option<Self> {
        let name = path.file_name()?.to_str()?;
        let (steps, repetition) = name.strip_prefix("step-").map(|name| match name.split_once('-') {
            Some((steps, repetition)) => (steps, repetition),
            None => (name, "1"),
        })?;
        let (env_steps, repetition) = (steps.parse().ok()?, repetition.parse().ok()?);
        // Only names that this build gives: `step-5` and `step-+00000000005` are not ours.
        (self::name(env_steps, repetition) == name).then_some(Self { env_steps, repetition, path })
    }

    /// What its manifest says, whether or not that is in order.
    pub fn manifest(&self) -> Option<Manifest> {
        let text = rit_config::read_regular(&self.path.join(MANIFEST), FILE_BYTES_MAX);
        serde_json::from_slice(&text.ok()?).ok()
    }
}

fn name(env_steps: u64, repetition: u64) -> String {
    match repetition {
        1 => format!("step-{env_steps:012}"),
        _ => format!("step-{env_steps:012}-{repetition}"),
    }
}

/// The folders called like checkpoints, oldest first; none where there is no folder for them.
pub(super) fn list(all: &Path) -> Result<Vec<Folder>, CheckpointError> {
    let entries = match fs::read_dir(all) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(io(all))?,
    };
    let mut folders = Vec::new();
    for entry in entries {
        folders.extend(Folder::parse(entry.map_err(io(all))?.path()));
    }
    folders.sort();
    Ok(folders)
}

/// Those whose manifest says the step that their name says: what counts when some are kept and others go.
pub(super) fn list_named_right(all: &Path) -> Result<Vec<(Folder, Manifest)>, CheckpointError> {
    let with_manifest = |folder: Folder| {
        let manifest = folder.manifest()?;
        (manifest.progress.env_steps == folder.env_steps).then_some((folder, manifest))
    };
    Ok(list(all)?.into_iter().filter_map(with_manifest).collect())
}

/// A name that no checkpoint has: that of the next one at this step.
pub(super) fn free_name(all: &Path, env_steps: u64) -> Result<String, CheckpointError> {
    let taken = list(all)?.into_iter().filter(|folder| folder.env_steps == env_steps);
    let last = taken.map(|folder| folder.repetition).max();
    Ok(name(env_steps, last.map_or(1, |last| last.saturating_add(1))))
}

/// Removes what writers that were killed have left half-written.
pub(super) fn remove_partial(all: &Path) -> Result<(), CheckpointError> {
    for entry in fs::read_dir(all).map_err(io(all))? {
        let path = entry.map_err(io(all))?.path();
        let is_partial = path.extension().is_some_and(|ending| ending == PARTIAL)
            && Folder::parse(path.with_extension("")).is_some();
        if is_partial {
            fs::remove_dir_all(&path).map_err(io(&path))?;
        }
    }
    Ok(())
}

/// Removes what is older than the newest `keep` steps, of which `written` is the newest. What cannot be removed stays,
/// and is tried again the next time.
pub(super) fn forget_old(all: &Path, written: &Folder, keep: usize) -> Result<(), CheckpointError> {
    let older = list_named_right(all)?.into_iter().map(|(folder, _)| folder);
    let mut older: Vec<Folder> = older.filter(|folder| folder < written).collect();
    let mut kept = vec![written.env_steps];
    while let Some(folder) = older.pop() {
        if kept.contains(&folder.env_steps) || kept.len() >= keep {
            if let Err(error) = fs::remove_dir_all(&folder.path) {
                tracing::warn!(path = %folder.path.display(), %error, "an old checkpoint stays");
            }
        } else {
            kept.push(folder.env_steps);
        }
    }
    Ok(())
}

/// The folder of this name.
pub(super) fn named(all: &Path, name: &str) -> Option<Folder> {
    Folder::parse(all.join(name))
}

/// Renames a damaged checkpoint, so that it does not count any more, and returns its new place; `None` if it cannot be
/// renamed.
pub(super) fn set_aside(folder: &Path) -> Option<PathBuf> {
    let free = damaged::free_place(folder)?;
    fs::rename(folder, &free).ok()?;
    Some(free)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_sort_by_step_and_repetition_and_others_are_no_checkpoints() {
        let all = tempfile::tempdir().unwrap();
        let others =
            ["step-5", "step-+00000000005", "step-000000000005.partial", "step-000000000005-1", "latest"];
        let ours = ["step-000000000005", "step-000000000005-2", "step-000000000005-10", "step-000000000040"];
        for name in ours.iter().rev().chain(&others) {
            fs::create_dir(all.path().join(name)).unwrap();
        }
        let names: Vec<_> = list(all.path())
            .unwrap()
            .into_iter()
            .map(|folder| folder.path.file_name().unwrap().to_owned())
            .collect();
        assert_eq!(names, ours);
        assert_eq!(free_name(all.path(), 5).unwrap(), "step-000000000005-11");
        assert_eq!(free_name(all.path(), 6).unwrap(), "step-000000000006");
        remove_partial(all.path()).unwrap();
        assert!(!all.path().join(others[2]).exists() && all.path().join(others[0]).exists());
        assert!(list(&all.path().join("nowhere")).unwrap().is_empty());
    }

    #[test]
    fn what_is_set_aside_twice_is_there_twice() {
        let all = tempfile::tempdir().unwrap();
        let folder = all.path().join("step-000000000005");
        let mut places = Vec::new();
        for _ in 0..2 {
            fs::create_dir(&folder).unwrap();
            places.push(set_aside(&folder).unwrap());
        }
        assert!(
            places[0].ends_with("step-000000000005.damaged")
                && places[1].ends_with("step-000000000005.damaged-2")
        );
        assert!(list(all.path()).unwrap().is_empty());
    }
}
