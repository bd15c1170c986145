//! Committed records: what of a run is kept under version control, in two small files.
//!
//! `NAME.jsonl` is the run's metrics file without the lines of training, its header with the settings as they were at the
//! end. Of evaluations on schedule it has means alone, which is all that a curve needs; of those at the end every episode.
//! `NAME.json` is the summary. Builds before there were headers kept a summary inside an object, beside evaluations
//! of the testing tasks; with what settings they trained, a file [`SETTINGS`] in their folder may say.

use crate::{
    Evaluation, Line, Lines, Occasion, RecordError, Summary, TaskResult, record::settings, shapley,
    summary::BYTES_MAX,
};
use rit_config::{RunDir, write_whole};
use serde_json::{Map, Value};
use std::{
    collections::BTreeMap,
    io::ErrorKind,
    path::{Path, PathBuf},
};

/// Settings of the records in its folder that say none themselves, each `section.key` with its value, as a header has them.
const SETTINGS: &str = "settings.json";

/// The settings of a folder's records that say none; empty where there is no such file.
pub(crate) fn folder_settings(metrics: &Path) -> Result<BTreeMap<String, String>, RecordError> {
    let path = metrics.with_file_name(SETTINGS);
    let text = match rit_config::read_regular(&path, BYTES_MAX) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(BTreeMap::new()),
        text => text.map_err(RecordError::io(&path))?,
    };
    serde_json::from_slice(&text).map_err(|error| RecordError::Other {
        path,
        what: "list of settings",
        why: error.to_string(),
    })
}

/// What lies beside the lines.
#[derive(Debug, Default)]
pub(crate) struct Committed {
    pub(crate) summary: Option<Summary>,
    /// Evaluations of testing tasks that older records hold, those of most episodes last.
    pub(crate) testing: Vec<BTreeMap<String, TaskResult>>,
}

/// Reads `NAME.json`; nothing where there is none.
pub(crate) fn read(path: &Path) -> Result<Committed, RecordError> {
    let text = match rit_config::read_regular(path, BYTES_MAX) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Committed::default()),
        text => text.map_err(RecordError::io(path))?,
    };
    let other = |error: serde_json::Error| RecordError::Other {
        path: path.to_owned(),
        what: "summary of a run",
        why: error.to_string(),
    };
    let mut found: Map<String, Value> = serde_json::from_slice(&text).map_err(other)?;
    let Some(inner) = found.remove("summary") else {
        let summary = Summary::parse(Value::Object(found)).map_err(RecordError::io(path))?;
        return Ok(Committed { summary: Some(summary), testing: Vec::new() });
    };
    let mut summary = Summary::parse(inner).map_err(RecordError::io(path))?;
    let mut testing = Vec::new();
    for (key, value) in found {
        let episodes = key.strip_prefix("testing_").and_then(|key| key.strip_suffix("_episodes"));
        match episodes.and_then(|episodes| episodes.parse::<u64>().ok()) {
            Some(episodes) => {
                let mut tasks: BTreeMap<String, TaskResult> = serde_json::from_value(value).map_err(other)?;
                tasks.iter_mut().for_each(|(task, result)| result.task.clone_from(task));
                testing.push((episodes, tasks));
            }
            None => {
                summary.other.insert(key, value);
            }
        }
    }
    testing.sort_by_key(|(episodes, _)| *episodes);
    let testing = testing.into_iter().map(|(_, tasks)| tasks).collect();
    Ok(Committed { summary: Some(summary), testing })
}

/// Writes a finished run's record as `stem`.jsonl and `stem`.json. Returns both.
///
/// # Errors
/// When the run has not ended, when one of the files is there, or the disk refuses.
pub fn commit(root: &Path, stem: &Path) -> Result<[PathBuf; 2], RecordError> {
    let (run_dir, config) = RunDir::open(root)?;
    let summary = run_dir.summary();
    let summary = rit_config::read_regular(&summary, BYTES_MAX).map_err(RecordError::io(&summary))?;
    let metrics = run_dir.metrics();
    let mut lines = Lines::open(&metrics)?;
    let mut text = Vec::new();
    if let Some(header) = lines.header() {
        let mut header = header.clone();
        if let Some(run) = &mut header.run {
            run.settings = settings(&run_dir, &config)?;
        }
        text.extend(header.line().map_err(RecordError::io(&metrics))?);
    }
    while let Some(mut line) = lines.next_line()? {
        match &mut line {
            Line::Training(_) => continue,
            Line::Evaluation(Evaluation { occasion: Occasion::Scheduled, tasks, .. }) => {
                tasks.values_mut().for_each(|task| task.each = None);
            }
            _ => {}
        }
        serde_json::to_writer(&mut text, &line).map_err(|error| RecordError::io(&metrics)(error.into()))?;
        text.push(b'\n');
    }
    let [metrics, ended] = ["jsonl", "json"].map(|extension| with_added(stem, extension));
    if ended.exists() {
        return Err(RecordError::io(ended)(ErrorKind::AlreadyExists.into()));
    }
    shapley::commit(root, stem)?;
    // The last makes it whole: lines without a summary are what a process that was killed has left.
    write_whole(&metrics, &text).map_err(RecordError::io(&metrics))?;
    write_whole(&ended, &summary).map_err(RecordError::io(&ended))?;
    Ok([metrics, ended])
}

/// `with_extension` would take what follows a name's last dot away, such as that of `gamma-0.8`.
fn with_added(stem: &Path, extension: &str) -> PathBuf {
    let mut name = stem.as_os_str().to_owned();
    name.push(".");
    name.push(extension);
    name.into()
}
