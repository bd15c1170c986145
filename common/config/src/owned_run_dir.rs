//! A run directory in the hands of the one process that writes to it: made, gone on with, and given back.

use crate::{
    Config, RunDir, RunDirError, method_keys,
    resolve::may_go_on,
    run_dir::{
        CONFIG, INITIAL_WEIGHTS, LINEAGE, RUN_ID, TOKEN, existing, hex, random_bytes, read_config, utf8,
        why_missing,
    },
    run_lock::{LOCK, RunLock},
    run_place::{self, Came, PLACE},
    saved::{Saved, resolve_saved},
    write_whole,
};
use std::{
    fs::{self, DirBuilder, OpenOptions, Permissions},
    io::{self, ErrorKind, Write as _},
    os::{
        fd::{AsFd, BorrowedFd},
        unix::fs::{DirBuilderExt as _, OpenOptionsExt as _, PermissionsExt as _},
    },
    path::{Path, PathBuf},
};

/// What a learner leaves in its run directory to be found by, and what this crate writes: files that no other
/// program can use.
const FOUND_BY: [&str; 5] = ["address", "remote_address", "web", "learner.sock", "shared_memory"];

/// A run directory under its lock: no other process writes to it until this value, and every child process that was
/// handed the lock, is gone.
#[derive(Debug)]
pub struct OwnedRunDir {
    run_dir: RunDir,
    /// Nothing where the parent process holds it for this one.
    lock: Option<RunLock>,
    before: Before,
    notices: Vec<String>,
}

/// What the directory was before.
#[derive(Debug)]
enum Before {
    /// Not there, or empty.
    Nothing { folder_made: bool },
    /// A run with this configuration.
    Run { config: String },
}

impl OwnedRunDir {
    /// Makes a directory for a new run and writes the resolved configuration into it.
    ///
    /// # Errors
    /// When the directory holds anything already, or cannot be written: then nothing is left of the attempt.
    pub fn create(root: &Path, config: &Config) -> Result<Self, RunDirError> {
        utf8(root)?;
        if let Some(parent) = root.parent().filter(|parent| !parent.as_os_str().is_empty()) {
            let made = DirBuilder::new().recursive(true).mode(0o700).create(parent);
            made.map_err(|error| why_not_made(root, error))?;
        }
        match DirBuilder::new().mode(0o700).create(root) {
            Ok(()) => Self::fill(root, true, config),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                refuse_occupied(&existing(root)?, root)?;
                Self::fill(root, false, config)
            }
            Err(error) => Err(why_not_made(root, error)),
        }
    }

    /// Makes the next free directory `{parent}/{name}-{n}`; of two that do so at once, each gets its own.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn create_fresh(parent: &Path, name: &str, config: &Config) -> Result<Self, RunDirError> {
        let made = DirBuilder::new().recursive(true).mode(0o700).create(parent);
        made.map_err(|error| why_not_made(parent, error))?;
        let mut n = 1;
        loop {
            let root = parent.join(format!("{name}-{n}"));
            match DirBuilder::new().mode(0o700).create(&root) {
                Ok(()) => return Self::fill(&root, true, config),
                Err(error) if error.kind() == ErrorKind::AlreadyExists => n += 1,
                Err(error) => return Err(why_not_made(&root, error)),
            }
        }
    }

    /// Opens a run's directory to go on with other settings, and writes the new configuration down.
    ///
    /// # Errors
    /// When it holds no run or another process has it, or when a setting would change the result of what has been
    /// trained already. Then nothing has been changed.
    pub fn resume(root: &Path, settings: &[toml::Table]) -> Result<(Self, Config), RunDirError> {
        let root = existing(root)?;
        read_config(&root)?;
        let lock = RunLock::take(&root)?;
        let text = read_config(&root)?;
        let (run_dir, old) = RunDir::open(&root)?;
        let wrong = |error| RunDirError::Config { path: root.join(CONFIG), error };
        method_keys::same(old.algorithm.name, settings).map_err(wrong)?;
        let Saved { config: new, notices } = resolve_saved(&text, settings).map_err(wrong)?;
        may_go_on(&old, &new).map_err(wrong)?;
        let mut owned = Self { run_dir, lock: Some(lock), before: Before::Run { config: text }, notices };
        owned.begin()?;
        // What an older build did not write is written from now on.
        if new != old || !owned.notices.is_empty() {
            owned.run_dir.write_config(&new)?;
        }
        Ok((owned, new))
    }

    /// Opens a run's directory for a process that the run's first may have started: then it has handed its lock down.
    ///
    /// # Errors
    /// When it holds no run, or another process has it.
    pub fn open(root: &Path, is_child: bool) -> Result<(Self, Config), RunDirError> {
        let root = existing(root)?;
        if !(is_child && RunLock::is_handed_down(&root)) {
            return Self::resume(&root, &[]);
        }
        RunLock::tell_holder(&root, false);
        let text = read_config(&root)?;
        let (run_dir, config) = RunDir::open(&root)?;
        let before = Before::Run { config: text };
        Ok((Self { run_dir, lock: None, before, notices: Vec::new() }, config))
    }

    /// The directory, for readers.
    pub fn run_dir(&self) -> &RunDir {
        &self.run_dir
    }

    /// The lock, for a child process to hold at [`RunLock::CHILD_FD`].
    pub fn lock(&self) -> Option<BorrowedFd<'_>> {
        self.lock.as_ref().map(AsFd::as_fd)
    }

    /// What the person who started the run has to be told.
    pub fn notices(&self) -> &[String] {
        &self.notices
    }

    /// For a run that never began: removes what [`Self::create`] has made and what the run's own processes have left,
    /// by name, and nothing else; gives a run that was there its configuration back.
    ///
    /// # Errors
    /// When something would not go.
    pub fn undo(self) -> Result<(), RunDirError> {
        let root = self.run_dir.root();
        let io = |path: &Path| {
            let path = path.to_owned();
            move |error| RunDirError::Io { path, error }
        };
        match &self.before {
            // What was trained is no beginning.
            Before::Nothing { .. } if self.run_dir.metrics().exists() => Ok(()),
            Before::Nothing { folder_made } => remove_beginning(root, *folder_made).map_err(io(root)),
            Before::Run { config } if read_config(root)? != *config => {
                let path = root.join(CONFIG);
                write_whole(&path, config.as_bytes()).map_err(io(&path))
            }
            Before::Run { .. } => Ok(()),
        }
    }

    /// Takes an empty directory and writes a run's first files.
    fn fill(root: &Path, folder_made: bool, config: &Config) -> Result<Self, RunDirError> {
        let found = existing(root)?;
        let lock = RunLock::take(&found)?;
        // Another may have come between the first look and the lock.
        refuse_occupied(&found, root)?;
        let filled = fill(&found, config);
        if filled.is_err() {
            // What cannot be written can perhaps not be removed either: the first error is the one to tell.
            let _ = remove_beginning(&found, folder_made);
        }
        let before = Before::Nothing { folder_made };
        Ok(Self { run_dir: filled?, lock: Some(lock), before, notices: Vec::new() })
    }

    /// Says who has the run, and gives a copy an identity of its own.
    fn begin(&mut self) -> Result<(), RunDirError> {
        let root = self.run_dir.root().to_owned();
        let came = run_place::came(&root, RUN_ID)?;
        let io = |error| RunDirError::Io { path: root.clone(), error };
        RunLock::tell_holder(&root, true);
        if let Came::CopiedFrom(other) = &came {
            let (run_id, token) = (random_bytes().map_err(io)?, hex(random_bytes().map_err(io)?));
            // In this order: cut short, it is begun again.
            let lineage = self.run_dir.lineage();
            for (name, digits) in [(LINEAGE, &hex(lineage)), (TOKEN, &token), (RUN_ID, &hex(run_id))] {
                let path = root.join(name);
                let written = write_whole(&path, format!("{digits}\n").as_bytes());
                written.map_err(|error| RunDirError::Io { path, error })?;
            }
            // They lead to the other's learner.
            for path in FOUND_BY.map(|name| root.join(name)) {
                remove_if_there(&path).map_err(|error| RunDirError::Io { path, error })?;
            }
            self.run_dir = RunDir { root: root.clone(), run_id, lineage, token };
            self.notices.push(format!(
                "{} is a copy of {}: it goes on as a run of its own, with a run_id and a token of its own",
                root.display(),
                other.display()
            ));
        }
        if came != Came::MadeHere || !root.join(PLACE).exists() {
            run_place::write(&root).map_err(io)?;
        }
        Ok(())
    }
}

fn why_not_made(root: &Path, error: io::Error) -> RunDirError {
    // A file on the way there is what the system calls existing.
    if let Some(file) = root.ancestors().find(|path| path.is_file()) {
        return RunDirError::NotADirectory(file.to_owned());
    }
    match why_missing(root, error) {
        // It is to be made: that it is missing is no reason.
        RunDirError::Missing { root, .. } => RunDirError::NotMade(root),
        other => other,
    }
}

/// Whether a new run may lie there. `typed` is how a person calls it.
fn refuse_occupied(root: &Path, typed: &Path) -> Result<(), RunDirError> {
    let entries = fs::read_dir(root).map_err(|error| RunDirError::Io { path: typed.to_owned(), error })?;
    let names: Vec<_> = entries.filter_map(|entry| Some(entry.ok()?.file_name())).collect();
    if names.iter().any(|name| name == CONFIG) {
        return Err(RunDirError::Occupied(typed.to_owned()));
    }
    // Where only files can be locked, the lock is there.
    match names.iter().find(|&name| name != LOCK) {
        Some(name) => Err(RunDirError::NotEmpty {
            root: typed.to_owned(),
            entry: name.to_string_lossy().escape_debug().to_string(),
        }),
        None => Ok(()),
    }
}

/// A run's first files.
fn fill(root: &Path, config: &Config) -> Result<RunDir, RunDirError> {
    let io = |path: &Path| {
        let path = path.to_owned();
        move |error| RunDirError::Io { path, error }
    };
    fs::set_permissions(root, Permissions::from_mode(0o700)).map_err(io(root))?;
    RunLock::tell_holder(root, true);
    let run_id = random_bytes().map_err(io(root))?;
    let token = hex(random_bytes().map_err(io(root))?);
    let write = |path: PathBuf, text: String| {
        let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&path);
        file.and_then(|mut file| file.write_all(text.as_bytes())).map_err(io(&path))
    };
    write(root.join(RUN_ID), hex(run_id) + "\n")?;
    write(root.join(TOKEN), token.clone() + "\n")?;
    run_place::write(root).map_err(io(root))?;
    let run_dir = RunDir { root: root.to_owned(), run_id, lineage: run_id, token };
    for folder in [run_dir.logs(), run_dir.checkpoints()] {
        DirBuilder::new().mode(0o700).create(&folder).map_err(io(&folder))?;
    }
    // Last: with it, it is a run.
    write(run_dir.config_path(), run_dir.to_toml(config)?)?;
    Ok(run_dir)
}

/// Removes what a run that never began consists of. Whatever else lies there stays, and the folder with it.
fn remove_beginning(root: &Path, folder_made: bool) -> io::Result<()> {
    let logs = root.join("logs");
    for entry in fs::read_dir(&logs).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if ["learner.log", "train.log"].contains(&&*name)
            || (name.starts_with("actor-") && name.ends_with(".log"))
        {
            remove_if_there(&entry.path())?;
        }
    }
    for name in [RUN_ID, TOKEN, PLACE, CONFIG, LOCK, INITIAL_WEIGHTS].iter().chain(&FOUND_BY) {
        let path = root.join(name);
        remove_if_there(&path)?;
        remove_if_there(&path.with_extension("partial"))?;
    }
    let folders = ["logs", "checkpoints", "replay"].map(|name| root.join(name)).into_iter();
    for folder in folders.chain(folder_made.then(|| root.to_owned())) {
        match fs::remove_dir(&folder) {
            Err(error) if !matches!(error.kind(), ErrorKind::NotFound | ErrorKind::DirectoryNotEmpty) => {
                return Err(error);
            }
            _ => {}
        }
    }
    Ok(())
}

fn remove_if_there(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests;
