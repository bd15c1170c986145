//! TensorBoard event files: the scalars of `metrics.jsonl` over environment steps.
//!
//! A file is a row of TFRecords: length (u64), its masked CRC-32C, data, the data's masked CRC-32C, all
//! little-endian; the data is a protobuf `Event`. Each learner writes a file of its own. One that goes on from a
//! checkpoint first cuts away what was written after it, so that there is one point a step. Each file begins with a
//! session's start: a TensorBoard that is running then forgets what it had seen from that step on; before it stands
//! whose the file is. Files that end in part of a record are cut after the last whole one.

use crate::append_file::AppendFile;
use crc::{CRC_32_ISCSI, Crc};
use prost::Message;
use rit_config::RunDir;
use rit_record::{Evaluation, Line, Occasion, TaskResult, TrainingPoint};
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeMap,
    fs::{self, DirBuilder, OpenOptions},
    io,
    os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _},
    path::Path,
    time::{SystemTime, UNIX_EPOCH},
};

/// What TensorBoard knows event files by; seconds since 1970 follow, so that names sort by time.
const PREFIX: &str = "events.out.tfevents.";

/// Raise it when a tag's meaning changes.
const FORMAT_VERSION: u32 = 1;

/// No event file is longer.
const FILE_BYTES_MAX: u64 = 1 << 32;

const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);

/// How far the event files go: what a checkpoint remembers.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Position {
    /// The newest file's name.
    pub file: String,
    /// Its length in bytes.
    pub len: u64,
}

/// Writes one event file.
#[derive(Debug)]
pub struct EventFile {
    file: AppendFile,
    name: String,
}

impl EventFile {
    /// Begins a file in this folder, after what lay there at `position`. Files and records after that were
    /// written by a learner that died, and will be written again: the first line to come has `from_env_steps` or
    /// more. Also returns warnings: files that had to be cut.
    ///
    /// # Errors
    /// When the folder or a file cannot be written.
    pub fn create(
        folder: &Path,
        run_dir: &RunDir,
        position: &Position,
        from_env_steps: u64,
    ) -> io::Result<(Self, Vec<String>)> {
        DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
        let (mut newest, mut warnings, mut seen) = (0, Vec::new(), false);
        for entry in fs::read_dir(folder)? {
            let name = entry?.file_name();
            let Some((name, number)) =
                name.to_str().and_then(|name| Some((name, name.strip_prefix(PREFIX)?.parse::<u64>().ok()?)))
            else {
                continue;
            };
            let path = folder.join(name);
            if name > position.file.as_str() {
                fs::remove_file(path)?;
            } else {
                let is_last = name == position.file;
                seen |= is_last;
                warnings.extend(cut(&path, is_last.then_some(position.len))?);
            }
            newest = newest.max(number);
        }
        if !seen && !position.file.is_empty() {
            warnings.push(format!("{} is gone", folder.join(&position.file).display()));
        }
        let name = format!("{PREFIX}{:010}", (wall_time() as u64).max(newest.saturating_add(1)));
        let path = folder.join(&name);
        let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&path)?;
        let mut events = Self { file: AppendFile::new(path, file, 0)?, name };
        events.append(0, What::FileVersion("brain.Event:2".into()));
        events.append(0, What::SourceMetadata(SourceMetadata { writer: writer(run_dir) }));
        let start = SessionLog { status: SessionStatus::Start.into() };
        events.append(from_env_steps, What::SessionLog(start));
        events.file.flush()?;
        Ok((events, warnings))
    }

    /// How far the files go.
    pub fn position(&self) -> Position {
        Position { file: self.name.clone(), len: self.file.written() }
    }

    /// Writes what a line says, or keeps it until the disk takes it.
    pub fn write(&mut self, line: &Line) {
        let summary = summary(line);
        if let Some(progress) = line.progress().filter(|_| !summary.value.is_empty()) {
            self.append(progress.env_steps, What::Summary(summary));
        }
    }

    /// Writes what the disk has refused so far.
    ///
    /// # Errors
    /// When it refuses again.
    pub fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }

    fn append(&mut self, env_steps: u64, what: What) {
        let event = Event { wall_time: wall_time(), step: env_steps as i64, what: Some(what) };
        self.file.append(&record(&event.encode_to_vec()));
    }
}

/// Whose a file is.
fn writer(run_dir: &RunDir) -> String {
    let run_id: String = run_dir.lineage().iter().map(|byte| format!("{byte:02x}")).collect();
    format!("rit {}, format {FORMAT_VERSION}, run {run_id}", env!("CARGO_PKG_VERSION"))
}

/// Cuts a file after its last whole record, or where a checkpoint says that it ends; what is said if records are
/// missing there.
fn cut(path: &Path, end: Option<u64>) -> io::Result<Option<String>> {
    let bytes = rit_config::read_regular(path, FILE_BYTES_MAX)?;
    let wanted = end.unwrap_or(bytes.len() as u64);
    let whole = whole_records(&bytes[..bytes.len().min(wanted as usize)]);
    if whole < bytes.len() {
        rit_config::open_regular(path, OpenOptions::new().write(true))?.set_len(whole as u64)?;
    }
    let warning = || {
        let path = path.display();
        format!(
            "{path} ends in part of a record or too early: it is cut after its last whole one; metrics.jsonl has the \
             same numbers"
        )
    };
    Ok(((whole as u64) < wanted).then(warning))
}

/// Bytes of whole records at the beginning.
fn whole_records(bytes: &[u8]) -> usize {
    let mut rest = bytes;
    let next = |rest: &mut &[u8]| -> Option<()> {
        let (len, after) = rest.split_first_chunk::<8>()?;
        let (len_crc, after) = after.split_first_chunk::<4>()?;
        let (data, after) = after.split_at_checked(usize::try_from(u64::from_le_bytes(*len)).ok()?)?;
        let (data_crc, after) = after.split_first_chunk::<4>()?;
        (*len_crc == masked_crc(len) && *data_crc == masked_crc(data)).then(|| *rest = after)
    };
    while next(&mut rest).is_some() {}
    bytes.len() - rest.len()
}

/// Seconds since 1970.
fn wall_time() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

fn record(data: &[u8]) -> Vec<u8> {
    let len = (data.len() as u64).to_le_bytes();
    [&len[..], &masked_crc(&len), data, &masked_crc(data)].concat()
}

fn masked_crc(data: &[u8]) -> [u8; 4] {
    CRC.checksum(data).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}

fn summary(line: &Line) -> Summary {
    let mut value = Vec::new();
    let scalar = |value: &mut Vec<Value>, tag: String, number: f64| {
        value.push(Value { tag, simple_value: Some(number as f32) });
    };
    let (group, tasks): (&str, &BTreeMap<String, TaskResult>) = match line {
        Line::Training(TrainingPoint { epsilon, measured, tasks, progress, .. }) => {
            for (name, number) in &measured.values {
                scalar(&mut value, format!("training/{name}"), *number);
            }
            for (name, number) in [
                ("epsilon", *epsilon),
                ("episodes", progress.episodes as f64),
                ("updates", progress.updates as f64),
            ] {
                scalar(&mut value, format!("training/{name}"), number);
            }
            ("exploring", tasks)
        }
        Line::Evaluation(Evaluation { occasion: Occasion::Scheduled, tasks, .. }) => ("greedy", tasks),
        // What is measured at a run's end is no point of its curves.
        Line::Evaluation(_) | Line::Other(_) => return Summary { value },
    };
    for (task, result) in tasks {
        scalar(&mut value, format!("{group}_return/{task}"), result.mean_return);
        if let Some(win_rate) = result.win_rate {
            scalar(&mut value, format!("{group}_win_rate/{task}"), win_rate);
        }
        if let Some(exploring) = result.exploring {
            scalar(&mut value, format!("policy_lag/{task}"), exploring.policy_lag as f64);
            scalar(&mut value, format!("episodes/{task}"), exploring.episodes_total as f64);
        }
    }
    Summary { value }
}

/// The fields of TensorFlow's `event.proto` and `summary.proto` that scalars need.
#[derive(Clone, PartialEq, Message)]
struct Event {
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(oneof = "What", tags = "3, 5, 7, 10")]
    what: Option<What>,
}

#[derive(Clone, PartialEq, prost::Oneof)]
enum What {
    #[prost(string, tag = "3")]
    FileVersion(String),
    #[prost(message, tag = "5")]
    Summary(Summary),
    #[prost(message, tag = "7")]
    SessionLog(SessionLog),
    #[prost(message, tag = "10")]
    SourceMetadata(SourceMetadata),
}

#[derive(Clone, PartialEq, Message)]
struct SourceMetadata {
    #[prost(string, tag = "1")]
    writer: String,
}

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Value>,
}

#[derive(Clone, PartialEq, Message)]
struct Value {
    #[prost(string, tag = "1")]
    tag: String,
    /// Part of a oneof: a zero that is left out would be no value.
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

#[derive(Clone, PartialEq, Message)]
struct SessionLog {
    #[prost(enumeration = "SessionStatus", tag = "1")]
    status: i32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, prost::Enumeration)]
#[repr(i32)]
enum SessionStatus {
    Unspecified = 0,
    Start = 1,
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_config::OwnedRunDir;
    use rit_env::Split;
    use rit_record::{Exploring, Progress};
    use std::path::PathBuf;

    /// The events of a file, both checksums of each verified.
    fn read(bytes: &[u8]) -> Vec<Event> {
        let (mut rest, mut events) = (bytes, Vec::new());
        while !rest.is_empty() {
            let (len_bytes, after) = rest.split_at(8);
            let len = u64::from_le_bytes(len_bytes.try_into().unwrap()) as usize;
            let (len_crc, after) = after.split_at(4);
            let (data, after) = after.split_at(len);
            let (data_crc, after) = after.split_at(4);
            assert_eq!((len_crc, data_crc), (&masked_crc(len_bytes)[..], &masked_crc(data)[..]));
            events.push(Event::decode(data).unwrap());
            rest = after;
        }
        events
    }

    /// The events of all files of a folder, in order of their names.
    fn read_all(folder: &Path) -> Vec<Vec<Event>> {
        let mut files: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        files.iter().map(|file| read(&fs::read(file).unwrap())).collect()
    }

    /// A run directory, its folder of event files, and a file begun there.
    struct Run {
        _folder: tempfile::TempDir,
        run_dir: RunDir,
    }

    impl Run {
        fn new() -> Self {
            let config = rit_config::resolve("environment.task_set = \"matrix-game\"", "test", &[]).unwrap();
            let folder = tempfile::tempdir().unwrap();
            let owned = OwnedRunDir::create(&folder.path().join("run"), &config).unwrap();
            let run_dir = owned.run_dir().clone();
            Self { _folder: folder, run_dir }
        }

        fn folder(&self) -> PathBuf {
            self.run_dir.tensorboard()
        }

        fn create(&self, position: &Position, from: u64) -> (EventFile, Vec<String>) {
            EventFile::create(&self.folder(), &self.run_dir, position, from).unwrap()
        }
    }

    /// (step, tag, value) of every scalar.
    fn scalars(events: &[Event]) -> Vec<(i64, String, f32)> {
        let mut scalars = Vec::new();
        for event in events {
            if let Some(What::Summary(summary)) = &event.what {
                let of = |value: &Value| (event.step, value.tag.clone(), value.simple_value.unwrap());
                scalars.extend(summary.value.iter().map(of));
            }
        }
        scalars
    }

    fn progress(env_steps: u64) -> Progress {
        Progress { env_steps, episodes: 40, updates: 7 }
    }

    fn evaluation(env_steps: u64) -> Line {
        let result = TaskResult {
            task: "game-1".to_owned(),
            episodes: 32,
            mean_return: -2.5,
            win_rate: Some(0.75),
            ..TaskResult::default()
        };
        Line::Evaluation(Evaluation::new(
            progress(env_steps),
            1.0,
            Occasion::Scheduled,
            Split::Training,
            &[result],
        ))
    }

    #[test]
    fn checksums_are_those_of_the_format() {
        // RFC 3720, B.4: 32 bytes of zeros.
        assert_eq!(CRC.checksum(&[0; 32]), 0x8a91_36aa);
        // 0x8a9136aa rotated right by 15 is 0x6d55_1522; plus 0xa282ead8.
        assert_eq!(u32::from_le_bytes(masked_crc(&[0; 32])), 0x0fd7_fffa);
    }

    #[test]
    fn lines_become_scalars_over_environment_steps() {
        let run = Run::new();
        let (mut events, _) = run.create(&Position::default(), 0);
        events.write(&evaluation(0));
        let measured = [("td_loss", 0.5), ("grad_norm", 3.0), ("q_total_mean", 0.0), ("target_mean", -1.5)];
        let measured = measured.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
        let exploring = Some(Exploring { episodes_total: 9, policy_lag: 1 });
        let result = TaskResult { episodes: 9, mean_return: 4.5, exploring, ..TaskResult::default() };
        let tasks = BTreeMap::from([("3v3".to_owned(), result)]);
        let point = TrainingPoint { progress: progress(100), wall_s: 2.0, epsilon: 0.125, measured, tasks };
        events.write(&Line::Training(point));
        let Line::Evaluation(last) = evaluation(100) else { panic!("it is one") };
        events.write(&Line::Evaluation(Evaluation { occasion: Occasion::Final, ..last }));
        let files = read_all(&run.folder());
        assert_eq!(files.len(), 1);
        assert_eq!(files[0][0].what, Some(What::FileVersion("brain.Event:2".into())));
        assert!(files[0].iter().all(|event| event.wall_time > 1.7e9));
        let expected = [
            (0, "greedy_return/game-1", -2.5),
            (0, "greedy_win_rate/game-1", 0.75),
            (100, "training/td_loss", 0.5),
            (100, "training/grad_norm", 3.0),
            (100, "training/q_total_mean", 0.0),
            (100, "training/target_mean", -1.5),
            (100, "training/epsilon", 0.125),
            (100, "training/episodes", 40.0),
            (100, "training/updates", 7.0),
            (100, "exploring_return/3v3", 4.5),
            (100, "policy_lag/3v3", 1.0),
            (100, "episodes/3v3", 9.0),
        ];
        let expected = expected.map(|(step, tag, number)| (step, tag.to_owned(), number));
        assert_eq!(scalars(&files[0]), expected);
    }

    #[test]
    fn no_step_is_there_twice_after_resuming() {
        let run = Run::new();
        let (mut first, _) = run.create(&Position::default(), 0);
        first.write(&evaluation(10));
        let at_checkpoint = first.position().clone();
        first.write(&evaluation(20));
        // A learner that goes on from there, and dies before its first checkpoint.
        let (mut second, _) = run.create(&at_checkpoint, 11);
        second.write(&evaluation(20));
        let (mut third, warnings) = run.create(&at_checkpoint, 11);
        assert!(warnings.is_empty(), "{warnings:?}");
        third.write(&evaluation(20));
        assert!(third.position().file > second.position().file, "a name that was never used");
        let files = read_all(&run.folder());
        let steps: Vec<Vec<i64>> =
            files.iter().map(|events| events.iter().map(|event| event.step).collect()).collect();
        assert_eq!(steps, [vec![0, 0, 0, 10], vec![0, 0, 11, 20]]);
        let start = SessionLog { status: SessionStatus::Start.into() };
        assert_eq!(files[1][2].what, Some(What::SessionLog(start)));
        let Some(What::SourceMetadata(source)) = &files[1][1].what else { panic!("{:?}", files[1][1]) };
        assert_eq!(source.writer, writer(&run.run_dir));
        // One that begins anew keeps nothing.
        run.create(&Position::default(), 0);
        assert_eq!(read_all(&run.folder()).len(), 1);
    }

    #[test]
    fn what_is_torn_is_cut_after_the_last_whole_record_and_said() {
        let run = Run::new();
        let (mut first, _) = run.create(&Position::default(), 0);
        let path = run.folder().join(&first.position().file);
        first.write(&evaluation(10));
        let one = first.position().len;
        first.write(&evaluation(20));
        let whole = first.position();
        let good = fs::read(&path).unwrap();
        let mut altered = good.clone();
        altered[one as usize + 14] ^= 1;
        for (bytes, kept, said) in [
            (&good[..], whole.len, 0),
            (&[&good[..], b"torn by a dead learner"].concat()[..], whole.len, 0),
            (&good[..good.len() - 1], one, 1),
            (&altered[..], one, 1),
            (&[], 0, 1),
        ] {
            fs::write(&path, bytes).unwrap();
            let (second, warnings) = run.create(&whole, 21);
            assert_eq!((fs::metadata(&path).unwrap().len(), warnings.len()), (kept, said), "{warnings:?}");
            fs::remove_file(run.folder().join(&second.position().file)).unwrap();
        }
        fs::remove_file(&path).unwrap();
        let (_, warnings) = run.create(&whole, 21);
        assert!(warnings[0].ends_with("is gone"), "{warnings:?}");
    }
}
