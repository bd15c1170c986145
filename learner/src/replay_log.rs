//! Replay on disk: every episode that entered training, in order of number, as the frames of the wire.
//!
//! Files of a fixed number of frames, each frame of the run's one length, so an episode's place follows from its
//! number. A checkpoint after N episodes needs the last `buffer_size` frames before N to be durable; what lies
//! after N was written by a learner that died, and is cut off.

use rit_config::open_regular;
use rit_episode::{
    Episode,
    wire::{self, EncodeError, Expected, Frame, Header, PayloadLayout, Rejection, RunId},
};
use std::{
    fs::{self, File, OpenOptions},
    io::{self, ErrorKind, Read as _, Seek as _, SeekFrom, Write as _},
    ops::Range,
    path::{Path, PathBuf},
};

/// Frames of one file.
const FRAMES_PER_FILE: u64 = 512;

/// Why replay cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum ReplayLogError {
    /// The system refused.
    #[error("{path}: {error}{}", remedy(error))]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// An episode that does not fit the run's dims.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// A frame that is not what was written.
    #[error("{path}: episode {number}: {rejection}")]
    Frame {
        /// The file.
        path: PathBuf,
        /// The episode.
        number: u64,
        /// What is wrong with it.
        rejection: Rejection,
    },
    /// The file was cut short.
    #[error("{path}: it ends before episode {number}, which was written to it")]
    Short {
        /// The file.
        path: PathBuf,
        /// The episode.
        number: u64,
    },
    /// A frame of another episode.
    #[error("{path}: episode {found} lies where {expected} should")]
    OutOfOrder {
        /// The file.
        path: PathBuf,
        /// The number found.
        found: u64,
        /// The number expected.
        expected: u64,
    },
}

/// What a person can do about a failed write.
pub(crate) fn remedy(error: &io::Error) -> &'static str {
    match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => "; free some space",
        ErrorKind::ReadOnlyFilesystem | ErrorKind::PermissionDenied => {
            "; make the run directory writable again"
        }
        _ => "",
    }
}

/// Writes replay.
#[derive(Debug)]
pub struct ReplayLog {
    folder: PathBuf,
    layout: PayloadLayout,
    run_id: RunId,
    frame: Frame,
    /// The next episode's number.
    next: u64,
    file: Option<File>,
}

impl ReplayLog {
    /// Goes on after episode `next` − 1: what comes after it is cut off.
    ///
    /// # Errors
    /// When the folder cannot be made or cut.
    pub fn open(
        folder: &Path,
        layout: PayloadLayout,
        run_id: RunId,
        next: u64,
    ) -> Result<Self, ReplayLogError> {
        let log =
            Self { folder: folder.to_owned(), layout, run_id, frame: Frame::new(&layout), next, file: None };
        let io = |error| ReplayLogError::Io { path: folder.to_owned(), error };
        fs::create_dir_all(folder).map_err(io)?;
        for first in files(folder).map_err(io)? {
            let path = log.path(first);
            let frames = next.saturating_sub(first).min(FRAMES_PER_FILE);
            let cut = if frames == 0 {
                fs::remove_file(&path)
            } else {
                open_regular(&path, OpenOptions::new().write(true)).and_then(|file| {
                    let keep = frames * log.frame_len();
                    if file.metadata()?.len() > keep { file.set_len(keep) } else { Ok(()) }
                })
            };
            cut.map_err(|error| ReplayLogError::Io { path, error })?;
        }
        Ok(log)
    }

    /// Writes the next episode, or a later one: those between are no longer wanted, and their place stays empty. A
    /// failed write leaves the log as it was.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn append(&mut self, episode: &Episode) -> Result<(), ReplayLogError> {
        debug_assert!(episode.number >= self.next, "episodes come in order");
        if episode.number > self.next {
            self.file = None;
            self.next = episode.number;
        }
        wire::encode(episode, &self.layout, self.run_id, 0, &mut self.frame)?;
        let (first, at) = (self.next - self.next % FRAMES_PER_FILE, self.next % FRAMES_PER_FILE);
        let (path, begin) = (self.path(first), at * self.frame_len());
        let io = |error| ReplayLogError::Io { path: path.clone(), error };
        if at == 0 {
            self.sync()?;
            self.file = None;
        }
        let mut file = match self.file.take() {
            Some(file) => file,
            None => {
                let mut options = OpenOptions::new();
                options.create(true).truncate(false).write(true);
                let mut file = open_regular(&path, &mut options).map_err(io)?;
                file.seek(SeekFrom::Start(begin)).map_err(io)?;
                file
            }
        };
        let written = file
            .write_all(bytemuck::bytes_of(&self.frame.header))
            .and_then(|()| file.write_all(&self.frame.payload));
        if let Err(error) = written {
            // Part of a frame may have been written: the next attempt opens the file anew and begins there again.
            let _ = file.set_len(begin);
            return Err(io(error));
        }
        self.file = Some(file);
        self.next += 1;
        Ok(())
    }

    /// Makes all that was written durable.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn sync(&mut self) -> Result<(), ReplayLogError> {
        let path = self.folder.clone();
        let synced = self.file.as_ref().map_or(Ok(()), File::sync_data);
        let synced = synced.and_then(|()| File::open(&path)?.sync_all());
        synced.map_err(|error| ReplayLogError::Io { path, error })
    }

    /// Removes files that hold nothing but episodes before this one.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn forget_before(&self, number: u64) -> Result<(), ReplayLogError> {
        let io = |path: &Path| {
            let path = path.to_owned();
            move |error| ReplayLogError::Io { path, error }
        };
        for first in files(&self.folder).map_err(io(&self.folder))? {
            if first.saturating_add(FRAMES_PER_FILE) <= number {
                let path = self.path(first);
                fs::remove_file(&path).map_err(io(&path))?;
            }
        }
        Ok(())
    }

    /// The next episode's number: all before it are written.
    pub fn next(&self) -> u64 {
        self.next
    }

    fn path(&self, first: u64) -> PathBuf {
        path(&self.folder, first)
    }

    fn frame_len(&self) -> u64 {
        frame_len(&self.layout)
    }
}

/// Reads episodes back, each checked as a frame from shared memory is.
///
/// # Errors
/// When one is missing or is not what was written.
pub fn read(folder: &Path, expected: &Expected, numbers: Range<u64>) -> Result<Vec<Episode>, ReplayLogError> {
    let mut episodes = Vec::with_capacity((numbers.end - numbers.start) as usize);
    let mut file: Option<(PathBuf, io::BufReader<File>)> = None;
    let mut header = bytemuck::Zeroable::zeroed();
    let mut payload = vec![0; expected.layout.len()];
    for number in numbers {
        let at = number % FRAMES_PER_FILE;
        let (path, reader) = match &mut file {
            Some(open) if at > 0 => open,
            file => {
                let path = path(folder, number - at);
                let opened = open_regular(&path, OpenOptions::new().read(true)).and_then(|mut file| {
                    file.seek(SeekFrom::Start(at * frame_len(&expected.layout)))?;
                    Ok(io::BufReader::with_capacity(1 << 20, file))
                });
                let reader = opened.map_err(|error| ReplayLogError::Io { path: path.clone(), error })?;
                refuse_other_layouts(&path, number)?;
                file.insert((path, reader))
            }
        };
        let read = reader
            .read_exact(bytemuck::bytes_of_mut::<Header>(&mut header))
            .and_then(|()| reader.read_exact(&mut payload));
        read.map_err(|error| match (error.kind(), path.clone()) {
            (ErrorKind::UnexpectedEof, path) => ReplayLogError::Short { path, number },
            (_, path) => ReplayLogError::Io { path, error },
        })?;
        let episode = wire::decode(&header, &payload, expected)
            .map_err(|rejection| ReplayLogError::Frame { path: path.clone(), number, rejection })?;
        if episode.number != number {
            let (path, found) = (path.clone(), episode.number);
            return Err(ReplayLogError::OutOfOrder { path, found, expected: number });
        }
        episodes.push(episode);
    }
    Ok(episodes)
}

/// Another build's frames may be of another length: looked for in their places, they would not be found. The first frame
/// begins with the file whatever its length.
fn refuse_other_layouts(path: &Path, number: u64) -> Result<(), ReplayLogError> {
    let mut header: Header = bytemuck::Zeroable::zeroed();
    let first = open_regular(path, OpenOptions::new().read(true))
        .and_then(|mut file| file.read_exact(bytemuck::bytes_of_mut(&mut header)));
    // A file too short, or one that begins with an empty place, is for the reader to find.
    if first.is_ok() && header.magic == wire::MAGIC && header.layout_version != wire::LAYOUT_VERSION {
        let rejection = Rejection::LayoutVersion { found: header.layout_version };
        return Err(ReplayLogError::Frame { path: path.to_owned(), number, rejection });
    }
    Ok(())
}

fn frame_len(layout: &PayloadLayout) -> u64 {
    (size_of::<Header>() + layout.len()) as u64
}

fn path(folder: &Path, first: u64) -> PathBuf {
    folder.join(format!("{first:012}.frames"))
}

/// The first numbers of the files there are. What is not called like one of ours is not ours.
fn files(folder: &Path) -> io::Result<Vec<u64>> {
    let mut firsts = Vec::new();
    for entry in fs::read_dir(folder)? {
        let name = entry?.file_name();
        let first: Option<u64> =
            name.to_str().and_then(|name| name.strip_suffix(".frames")).and_then(|n| n.parse().ok());
        firsts.extend(first.filter(|&first| path(folder, first).file_name() == Some(&*name)));
    }
    firsts.sort_unstable();
    Ok(firsts)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_env::{
        Embedded, Script, Split, TaskSet,
        rollout::{Job, Rollout, all_rolled},
    };
    use rit_episode::{Choice, RunSeed};
    use std::sync::Arc;

    const RUN: RunId = *b"a run's sixteen.";

    fn expected() -> Expected {
        let tasks = TaskSet::MatrixGame.tasks(Split::Training);
        Expected {
            run_id: RUN,
            layout: PayloadLayout::new(TaskSet::MatrixGame.dims()),
            tasks: tasks.into_iter().map(rit_env::Task::size).collect(),
        }
    }

    fn episodes(numbers: Range<u64>) -> Vec<Episode> {
        let tasks = TaskSet::MatrixGame.tasks(Split::Training);
        let mut rollout = Rollout::new(tasks, Arc::new(Embedded::default()), RunSeed(3), true);
        let jobs: Vec<Job> = numbers
            .map(|number| Job { number, weights_version: 7, choice: Choice::EpsilonGreedy(1.0), task: None })
            .collect();
        all_rolled(rollout.roll(&mut Script::Random, &jobs)).unwrap()
    }

    fn log(folder: &Path, next: u64) -> ReplayLog {
        ReplayLog::open(folder, expected().layout, RUN, next).unwrap()
    }

    #[test]
    fn episodes_come_back_across_files() {
        let folder = tempfile::tempdir().unwrap();
        let all = episodes(0..1300);
        let mut log = log(folder.path(), 0);
        all.iter().for_each(|episode| log.append(episode).unwrap());
        log.sync().unwrap();
        for range in [0..1300, 511..513, 700..1290, 1299..1300, 5..5] {
            let expected_ones = &all[range.start as usize..range.end as usize];
            assert_eq!(read(folder.path(), &expected(), range).unwrap(), expected_ones);
        }
        log.forget_before(1030).unwrap();
        assert!(read(folder.path(), &expected(), 1023..1300).is_err());
        assert_eq!(read(folder.path(), &expected(), 1024..1300).unwrap(), all[1024..]);
    }

    #[test]
    fn what_a_dead_learner_wrote_beyond_the_checkpoint_is_cut_off() {
        let folder = tempfile::tempdir().unwrap();
        let all = episodes(0..1100);
        let mut first = log(folder.path(), 0);
        all.iter().for_each(|episode| first.append(episode).unwrap());
        drop(first);
        let mut second = log(folder.path(), 600);
        assert!(read(folder.path(), &expected(), 599..601).is_err(), "600 is gone");
        all[600..700].iter().for_each(|episode| second.append(episode).unwrap());
        assert_eq!(read(folder.path(), &expected(), 400..700).unwrap(), all[400..700]);
    }

    #[test]
    fn what_replay_has_forgotten_before_it_could_be_written_is_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let all = episodes(0..800);
        let mut log = log(folder.path(), 0);
        all[..100].iter().chain(&all[300..800]).for_each(|episode| log.append(episode).unwrap());
        assert_eq!(read(folder.path(), &expected(), 0..100).unwrap(), all[..100]);
        assert_eq!(read(folder.path(), &expected(), 300..800).unwrap(), all[300..]);
        assert!(read(folder.path(), &expected(), 299..301).is_err(), "299 was never written");
    }

    #[test]
    fn what_was_altered_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = log(folder.path(), 0);
        episodes(0..10).iter().for_each(|episode| log.append(episode).unwrap());
        let path = folder.path().join("000000000000.frames");
        let good = fs::read(&path).unwrap();
        let frame = frame_len(&expected().layout) as usize;
        let error = |bytes: &[u8]| {
            fs::write(&path, bytes).unwrap();
            read(folder.path(), &expected(), 0..10).unwrap_err().to_string()
        };
        let mut altered = good.clone();
        altered[3 * frame + 100] ^= 1;
        assert!(error(&altered).contains("episode 3: the frame's checksum"));
        let swapped = [&good[frame..2 * frame], &good[..frame], &good[2 * frame..]].concat();
        assert!(error(&swapped).contains("episode 1 lies where 0 should"));
        assert!(error(&good[..good.len() - 1]).contains("it ends before episode 9"));
        // Frames of another build are of another length.
        let mut old = [&good[..frame - 8], &good[frame..]].concat();
        old[8] -= 1;
        assert!(
            error(&old).contains("the frame's layout is version 1, this build reads 2"),
            "{}",
            error(&old)
        );
    }

    #[test]
    fn other_files_stay_where_they_are() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = log(folder.path(), 0);
        episodes(0..2).iter().for_each(|episode| log.append(episode).unwrap());
        let others = ["5.frames", "+00000000512.frames", "18446744073709551615.frames", "notes.frames"];
        for name in others {
            fs::write(folder.path().join(name), "").unwrap();
        }
        log.forget_before(512).unwrap();
        let left: Vec<bool> = others.iter().map(|name| folder.path().join(name).exists()).collect();
        assert_eq!(left, [true; 4]);
        assert!(!folder.path().join("000000000000.frames").exists());
    }
}
