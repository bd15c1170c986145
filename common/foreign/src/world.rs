//! The factory of worlds that workers hold, and such a world.

use crate::{
    protocol::{Answer, Arrived, Open, Opened, Request, StateSizes, answer, read_state},
    worker::{Frame, Launch, Worker},
};
use rand::RngExt as _;
use rit_env::{Environment, EnvironmentError, EnvironmentFactory, FailureKind, Spec, Step, Task};
use rit_episode::{Action, Observation, Rng};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

/// A worker that several worlds share.
type Shared = Arc<Mutex<Worker>>;

/// Makes worlds in workers, several in each.
#[derive(Debug)]
pub struct PythonWorlds {
    launch: Arc<Launch>,
    workers: Arc<Mutex<Vec<Weak<Mutex<Worker>>>>>,
}

impl PythonWorlds {
    /// No worker is started before the first world begins.
    pub fn new(launch: Launch) -> Self {
        Self { launch: Arc::new(launch), workers: Arc::default() }
    }
}

impl EnvironmentFactory for PythonWorlds {
    fn build(&self, task: Task) -> Result<Box<dyn Environment>, EnvironmentError> {
        Ok(Box::new(PythonWorld::new(
            Arc::clone(&self.launch),
            Arc::clone(&self.workers),
            task.to_string(),
            task.spec(),
        )))
    }

    fn steps_elsewhere(&self) -> bool {
        true
    }
}

/// A world in a worker.
struct PythonWorld {
    launch: Arc<Launch>,
    workers: Arc<Mutex<Vec<Weak<Mutex<Worker>>>>>,
    task: String,
    spec: Spec,
    sizes: StateSizes,
    /// Its worker, and its number there; none before it begins.
    place: Option<(Shared, u16)>,
    /// Whether the worker has said that it is there.
    is_open: bool,
    arrived: Arrived,
}

impl PythonWorld {
    fn new(
        launch: Arc<Launch>,
        workers: Arc<Mutex<Vec<Weak<Mutex<Worker>>>>>,
        task: String,
        spec: Spec,
    ) -> Self {
        let Spec { n_agents, n_entities, feature_dim, n_actions, .. } = spec;
        let sizes = StateSizes { n_agents, n_entities, n_features: feature_dim, n_actions };
        let arrived = Arrived::default();
        Self { launch, workers, task, spec, sizes, place: None, is_open: false, arrived }
    }

    /// Its place in a worker; asks for one first if it has none.
    fn place(&mut self) -> Result<(Shared, u16), EnvironmentError> {
        if let Some((worker, environment)) = &self.place {
            return Ok((Arc::clone(worker), *environment));
        }
        let worker = self.worker_with_room()?;
        let environment = {
            let mut worker = lock(&worker);
            let environment = worker.take_place();
            let open = Open {
                task: self.task.clone(),
                n_features: self.sizes.n_features,
                n_actions: self.sizes.n_actions,
                describe: false,
            };
            worker.send(Request::Open, environment, &serde_json::to_vec(&open).unwrap_or_default())?;
            environment
        };
        self.place = Some((Arc::clone(&worker), environment));
        Ok((worker, environment))
    }

    fn worker_with_room(&self) -> Result<Shared, EnvironmentError> {
        let mut workers = lock(&self.workers);
        workers.retain(|worker| worker.strong_count() > 0);
        let room = self.launch.environments_per_worker.max(1);
        if let Some(worker) =
            workers.iter().filter_map(Weak::upgrade).find(|worker| lock(worker).has_room(room))
        {
            return Ok(worker);
        }
        let worker = Arc::new(Mutex::new(Worker::start(&self.launch)?));
        workers.push(Arc::downgrade(&worker));
        Ok(worker)
    }

    /// Waits until the worker has the environment, and holds it to what the run knows of its task.
    fn opened(&mut self, worker: &mut Worker, environment: u16) -> Result<(), EnvironmentError> {
        if self.is_open {
            return Ok(());
        }
        let (kind, body) = worker.receive(environment)?;
        let opened = match answer(kind, &body) {
            Ok(Answer::Opened(opened)) => opened,
            Ok(Answer::Failed(failed)) => return Err(worker.raised(*failed)),
            Ok(_) => return Err(worker.misspoke(&"it did not say what the environment is")),
            Err(error) => return Err(worker.misspoke(&error)),
        };
        let Opened { n_agents, n_entities, .. } = *opened;
        if (n_agents, n_entities) != (self.spec.n_agents, self.spec.n_entities) {
            let detail = format!(
                "it has {n_agents} agents and {n_entities} entities now, and had {} and {} when the run began",
                self.spec.n_agents, self.spec.n_entities
            );
            return Err(EnvironmentError::new(FailureKind::BadAnswer, detail));
        }
        self.is_open = true;
        Ok(())
    }

    /// Reads the state that the worker has sent.
    fn arrive(&mut self, worker: &mut Worker, (kind, body): &Frame) -> Result<(), EnvironmentError> {
        match answer(*kind, body) {
            Ok(Answer::State) => {
                let read = read_state(body, &self.sizes, &mut self.arrived);
                // The frame was whole, so the others in the worker are sound.
                read.map_err(|error| EnvironmentError::new(FailureKind::BadAnswer, error.to_string()))
            }
            Ok(Answer::Failed(failed)) => Err(worker.raised(*failed)),
            Ok(_) => Err(worker.misspoke(&"it did not send a state")),
            Err(error) => Err(worker.misspoke(&error)),
        }
    }
}

impl Environment for PythonWorld {
    fn spec(&self) -> Spec {
        self.spec
    }

    fn begin_reset(&mut self, rng: &mut Rng) -> Result<(), EnvironmentError> {
        // Seeds that every generator takes: of numbers of 31 bits.
        let seed = u64::from(rng.random::<u32>() >> 1);
        let (worker, environment) = self.place()?;
        lock(&worker).send(Request::Reset, environment, &seed.to_le_bytes())
    }

    fn reset(&mut self, _: &mut Rng) -> Result<(), EnvironmentError> {
        let (worker, environment) = self.place()?;
        let mut worker = lock(&worker);
        self.opened(&mut worker, environment)?;
        let frame = worker.receive(environment)?;
        self.arrive(&mut worker, &frame)
    }

    fn observe(&self, observation: &mut Observation) {
        observation.clone_from(&self.arrived.observation);
    }

    fn begin_step(&mut self, actions: &[Action]) -> Result<(), EnvironmentError> {
        let (worker, environment) = self.place()?;
        lock(&worker).send(Request::Step, environment, actions)
    }

    fn step(&mut self, _: &[Action], _: &mut Rng) -> Result<Step, EnvironmentError> {
        let (worker, environment) = self.place()?;
        let mut worker = lock(&worker);
        let frame = worker.receive(environment)?;
        self.arrive(&mut worker, &frame)?;
        let Arrived { reward, end, won, .. } = self.arrived;
        Ok(Step { reward, shaping: 0.0, end, won })
    }
}

impl Drop for PythonWorld {
    fn drop(&mut self) {
        if let Some((worker, environment)) = self.place.take() {
            lock(&worker).give_up(environment);
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // What a thread that panicked has left is found broken by the next frame.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
