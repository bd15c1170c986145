//! A checkpoint and replay as they lie on disk: see [`rit_learner::checkpoint`].

use crate::frame;
use rit_algo::{Learner, Model, learner::NamedState};
use rit_config::{Config, OwnedRunDir, RunDir};
use rit_env::{Split, TaskSet};
use rit_episode::{
    Episode, Stream,
    wire::{Expected, Header, PayloadLayout},
};
use rit_learner::{
    checkpoint::{self, Manifest, Origin, SnapshotMark, TrainingState},
    ledger::{Ledger, Terms},
    replay_log::ReplayLog,
    tensorboard::Position,
    trainer::{Algorithm, Made, TrainError, Trainer, Work},
    weights::Snapshot,
    write_queue::write_queue,
};
use rit_policy::{TaskNames, place::LATEST, weights_file};
use rit_record::{Exploring, Progress};
use serde_json::Value;
use sha2::{Digest as _, Sha256};
use std::{
    fs,
    path::{Path, PathBuf},
    sync::{Arc, mpsc},
};

/// The files of a checkpoint and of its replay. The first byte of an input says which one the rest of it replaces.
const FILES: [&str; 5] =
    ["checkpoint.json", "weights.safetensors", "state.safetensors", "000000000000.frames", "SHA256SUMS"];
const MANIFEST: usize = 0;
const FRAMES: usize = 3;
const SUMS: usize = 4;

/// Fixed, so that a kept input means the same in every run directory.
const RUN_ID: &str = "612072756e2773207369787465656e2e";

const EPISODES: u64 = 6;
const UPDATES: u64 = 3;

/// A small model and a short replay: the sizes of an input, not its code paths.
const EXPERIMENT: &str = "
    environment.task_set = 'matrix-game'
    algorithm = { buffer_size = 4, batch_size = 2, n_rollout_threads = 2 }
    learner.threads = 1
    evaluation.episodes = 1
    checkpoints.last_retry_ms = 0
    [network]
    hidden_dim = 2
    attention_dim = 2
    task_representation_dim = 2
    reward_embed_dim = 2
    mixing_embed_dim = 2
    hypernet_embed_dim = 2
";

/// A run directory with one whole checkpoint, of which inputs replace one file at a time.
#[derive(Debug)]
pub struct Run {
    /// Removed at the end.
    _folder: tempfile::TempDir,
    run_dir: RunDir,
    config: Config,
    model: Arc<Model>,
    expected: Expected,
    /// The batch that comes next.
    next: Vec<Episode>,
    /// What was written, in the order of [`FILES`].
    whole: [Vec<u8>; FILES.len()],
}

impl Run {
    /// Writes a whole checkpoint.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn new() -> Result<Self, Box<dyn std::error::Error>> {
        let folder = tempfile::Builder::new().prefix("rit-fuzz-").tempdir()?;
        let config = rit_config::resolve(EXPERIMENT, "experiment", &[])?;
        let root = folder.path().join("run");
        OwnedRunDir::create(&root, &config)?;
        fs::write(root.join("run_id"), RUN_ID)?;
        let (run_dir, config) = RunDir::open(&root)?;
        let model = Arc::new(Model::new(config.model())?);
        let tasks = TaskSet::MatrixGame.tasks(Split::Training);
        let layout = PayloadLayout::new(TaskSet::MatrixGame.dims());
        let tasks = tasks.into_iter().map(rit_env::Task::size).collect();
        let expected = Expected { run_id: run_dir.run_id(), layout, tasks };

        let mut log = ReplayLog::open(&run_dir.replay(), layout, run_dir.run_id(), 0)?;
        let mut episodes = frame::matrix_episodes(EPISODES + config.algorithm.n_rollout_threads as u64);
        let next = episodes.split_off(EPISODES as usize);
        for episode in &episodes {
            log.append(episode)?;
        }
        let origin = Origin::of(&run_dir, &config)?;
        let state = state(&*learner(&model, &config)?, &config, origin);
        checkpoint::save(&run_dir, &model, &TaskNames::of(&config), &state, 1)?;
        let whole = FILES.map(|name| fs::read(path(&run_dir, name)).unwrap_or_default());
        Ok(Self { _folder: folder, run_dir, config, model, expected, next, whole })
    }

    /// Reads the checkpoint with one file replaced, and says whether it was accepted. What is accepted, training can
    /// go on from.
    ///
    /// # Panics
    /// When it cannot, or the disk refuses.
    pub fn check(&self, input: &[u8]) -> bool {
        let Some((&which, content)) = input.split_first() else { return false };
        let which = usize::from(which) % FILES.len();
        let mut content = content.to_vec();
        match which {
            FRAMES => self.mend_frames(&mut content),
            MANIFEST => self.mend_manifest(&mut content),
            _ => {}
        }
        self.write(which, &content);
        if which != SUMS {
            let file = |index: usize| if index == which { &content } else { &self.whole[index] };
            let sum = |index: usize| format!("{}  {}\n", sha256(file(index)), FILES[index]);
            self.write(SUMS, [0, 1, 2].map(sum).concat().as_bytes());
        }
        let accepted = self.load();
        self.write(which, &self.whole[which]);
        self.write(SUMS, &self.whole[SUMS]);
        accepted
    }

    #[allow(clippy::panic, reason = "that is how a fuzzer learns of it")]
    fn load(&self) -> bool {
        let Ok(learner) = learner(&self.model, &self.config) else { panic!("no threads") };
        let loaded = checkpoint::load_newest(&self.run_dir, &*learner, &self.expected, &self.config);
        let Ok(loaded) = loaded else { return false };
        let (to_write, _) = write_queue(0);
        let run_dir = self.run_dir.clone();
        let (config, made) = (self.config.clone(), Made::default());
        let algorithm = Algorithm { model: Arc::clone(&self.model), learner };
        let trainer = Trainer::new(config, run_dir, algorithm, loaded, Box::new(|_| ()), to_write, made);
        let Ok((trainer, board)) = trainer else { panic!("the trainer does not start") };

        let beginning = trainer.beginning();
        let algorithm = &self.config.algorithm;
        assert_eq!(
            beginning.terms.len(),
            algorithm.policy_lag + 1,
            "as many open batches as in any other run"
        );
        for terms in &beginning.terms {
            assert!((0.0..=1.0).contains(&terms.epsilon), "epsilon {}", terms.epsilon);
            assert!(
                board.get(terms.weights_version).is_some(),
                "a lease asks for weights that are not there"
            );
        }
        let mut ledger = Ledger::new(algorithm.n_rollout_threads, beginning.batches, beginning.terms);
        let lease = ledger.lease(0, 1).map(|lease| lease.episodes);
        assert_eq!(lease, Some(vec![beginning.standing.progress.episodes]), "the next episode is handed out");

        let (work, queue) = mpsc::channel();
        let sent = work.send(Work::Batch(self.next.clone()));
        assert!(sent.is_ok(), "the queue is here");
        drop(work);
        // There is no writer for the last checkpoint. Whatever the weights were altered to, their loss need not be finite.
        let trained = trainer.run(&queue);
        assert!(
            matches!(trained, Err(TrainError::Checkpoint(_) | TrainError::NotFinite { .. })),
            "{trained:?}"
        );
        true
    }

    /// Each frame's length and checksum made right: an input that fails there goes no further.
    fn mend_frames(&self, bytes: &mut [u8]) {
        for frame in bytes.chunks_exact_mut(size_of::<Header>() + self.expected.layout.len()) {
            let (header, payload) = frame.split_at_mut(size_of::<Header>());
            let mut mended: Header = bytemuck::pod_read_unaligned(header);
            frame::mend(&mut mended, payload);
            header.copy_from_slice(bytemuck::bytes_of(&mended));
        }
    }

    /// A manifest's origin made right, where it is one at all: an input of another run goes no further.
    fn mend_manifest(&self, bytes: &mut Vec<u8>) {
        let origin = |manifest: &[u8]| {
            serde_json::from_slice::<Value>(manifest)
                .ok()
                .and_then(|manifest| manifest.get("origin").cloned())
        };
        let Ok(Value::Object(mut manifest)) = serde_json::from_slice(bytes) else { return };
        manifest.extend(origin(&self.whole[MANIFEST]).map(|origin| ("origin".to_owned(), origin)));
        if let Ok(mended) = serde_json::to_vec(&manifest) {
            *bytes = mended;
        }
    }

    #[allow(clippy::expect_used, reason = "a full disk is no finding")]
    fn write(&self, which: usize, content: &[u8]) {
        fs::write(path(&self.run_dir, FILES[which]), content).expect("the run directory can be written");
    }

    /// Whole inputs to begin from: each file as it was written.
    pub fn seeds(&self) -> Vec<(String, Vec<u8>)> {
        let seed = |(which, name): (usize, &str)| {
            (name.to_owned(), [&[which as u8], &self.whole[which][..]].concat())
        };
        FILES.into_iter().enumerate().map(seed).collect()
    }
}

fn path(run_dir: &RunDir, name: &str) -> PathBuf {
    if name == FILES[FRAMES] {
        return run_dir.replay().join(name);
    }
    run_dir.checkpoints().join(LATEST).join(Path::new(name))
}

fn learner(model: &Arc<Model>, config: &Config) -> Result<Box<dyn Learner>, Box<dyn std::error::Error>> {
    let params = model.initial(&mut config.seed.stream(Stream::Weights, 0));
    Ok(model.learner(config.update(), params)?)
}

fn state(learner: &dyn Learner, config: &Config, origin: Origin) -> TrainingState {
    let params = learner.params().to_vec();
    let acting = &params[learner.acting()];
    let lag = config.algorithm.policy_lag as u64;
    TrainingState {
        best: None,
        learner: learner.state().into_iter().map(NamedState::into_owned).collect(),
        snapshots: (UPDATES - lag..=UPDATES)
            .map(|version| Snapshot::new(version, 2 * version, acting))
            .collect(),
        manifest: Manifest {
            origin,
            env_steps_before: 2 * EPISODES - 2,
            progress: Progress { env_steps: 2 * EPISODES, episodes: EPISODES, updates: UPDATES },
            target_copied_at: 2,
            terms: (UPDATES - lag..=UPDATES)
                .map(|weights_version| Terms { weights_version, epsilon: 0.5 })
                .collect(),
            snapshots: (UPDATES - lag..=UPDATES)
                .map(|version| SnapshotMark { version, env_steps: 2 * version })
                .collect(),
            recent: vec![vec![(88.0, true)], vec![(-3.5, false), (0.0, false)], vec![], vec![]],
            exploring: vec![Exploring { episodes_total: 2, policy_lag: 1 }; 4],
            metrics_len: 100,
            tensorboard: Position::default(),
            wall_s: 1.5,
            cpu_s: 2.5,
            best: None,
            evaluation: None,
            weights_digest: weights_file::digest(&params),
        },
        params,
    }
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}
