//! The native part of the Python module `rit`: trained policies, by the same code as `rit evaluate`. Arrays come and go as
//! bytes in native order; `python/rit/policy.py` gives them their shapes.

use pyo3::{
    create_exception, exceptions::PyValueError, prelude::*, pybacked::PyBackedBytes, sync::MutexExt as _,
};
use rit_episode::Observation;
use rit_policy::{State, TrainedPolicy};
use std::{
    borrow::Cow,
    fmt,
    path::PathBuf,
    sync::{Mutex, MutexGuard, PoisonError},
};

create_exception!(rit, RitError, PyValueError, "What this package cannot do, and why.");
create_exception!(rit, WeightsError, RitError, "Weights that cannot be used.");
create_exception!(rit, ActError, RitError, "What a policy cannot act in.");

/// What an episode's agents see, as Python hands it over: episode, agents, entities, features (f4), observable (u1),
/// available (u1), previous reward.
type Seen = (usize, usize, usize, PyBackedBytes, PyBackedBytes, PyBackedBytes, f32);

/// A trained policy. Calls from several threads come one after another.
#[pyclass(module = "rit._rit", frozen)]
struct NativePolicy(Mutex<TrainedPolicy>);

#[pymethods]
impl NativePolicy {
    /// Of a run directory, RUN@STEPS, a checkpoint or a weights file.
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let loaded = py.detach(|| TrainedPolicy::load(&path));
        loaded
            .map(|policy| Self(Mutex::new(policy)))
            .map_err(|error| WeightsError::new_err(error.to_string()))
    }

    /// What the weights file says of itself: JSON.
    fn description(&self, py: Python<'_>) -> PyResult<String> {
        self.policy(py).description().to_json().map_err(|error| WeightsError::new_err(error.to_string()))
    }

    /// Features, actions, and numbers in a task representation.
    fn sizes(&self, py: Python<'_>) -> (usize, usize, usize) {
        let policy = self.policy(py);
        (policy.feature_dim(), policy.n_actions(), policy.representation_dim())
    }

    /// Begins an episode.
    #[pyo3(signature = (episode, n_agents, order=None))]
    fn begin(&self, py: Python<'_>, episode: usize, n_agents: usize, order: Option<Vec<u8>>) -> PyResult<()> {
        self.policy(py).begin(episode, n_agents, order).map_err(refused)
    }

    /// One joint action of each episode that is given.
    fn act(&self, py: Python<'_>, seen: Vec<Seen>) -> PyResult<()> {
        let mut policy = self.policy(py);
        let (features, n_actions) = (policy.feature_dim(), policy.n_actions());
        let observations: Vec<Observation> =
            seen.iter().map(|seen| observation(seen, features, n_actions)).collect::<PyResult<_>>()?;
        let states: Vec<State<'_>> = seen
            .iter()
            .zip(&observations)
            .map(|(seen, observation)| State { episode: seen.0, observation, previous_reward: seen.6 })
            .collect();
        let policy = &mut *policy;
        py.detach(|| policy.act(&states)).map_err(refused)
    }

    /// The joint action of an episode's last step, an action a byte.
    fn actions(&self, py: Python<'_>, episode: usize) -> Cow<'static, [u8]> {
        self.policy(py).actions(episode).to_vec().into()
    }

    /// The utilities of an episode's last step, f4.
    fn utilities(&self, py: Python<'_>, episode: usize) -> Cow<'static, [u8]> {
        to_bytes(self.policy(py).utilities(episode))
    }

    /// The task representations of an episode's last step, f4.
    fn task_representations(&self, py: Python<'_>, episode: usize) -> Cow<'static, [u8]> {
        to_bytes(self.policy(py).task_representations(episode))
    }
}

impl NativePolicy {
    /// Waits for the policy without the interpreter's lock: another thread's `act` holds the policy, and needs that lock to
    /// come back.
    fn policy(&self, py: Python<'_>) -> MutexGuard<'_, TrainedPolicy> {
        // A call that panicked has not begun to change anything that the next one reads before writing it.
        self.0.lock_py_attached(py).unwrap_or_else(PoisonError::into_inner)
    }
}

fn refused(error: impl fmt::Display) -> PyErr {
    ActError::new_err(error.to_string())
}

fn observation(seen: &Seen, features: usize, n_actions: usize) -> PyResult<Observation> {
    let (episode, n, m, entities, observable, available, _) = seen;
    if n > m {
        return Err(refused(format!(
            "episode {episode}: {n} agents of {m} entities; agents are entities too"
        )));
    }
    for (what, found, expected) in [
        ("features", entities.len(), 4 * m * features),
        ("observable", observable.len(), n * m),
        ("available", available.len(), n * n_actions),
    ] {
        if found != expected {
            return Err(refused(format!("episode {episode}: {what} has {found} bytes, not {expected}")));
        }
    }
    let mut observation = Observation::new(*n, *m, features, n_actions);
    let (numbers, _) = entities.as_chunks::<4>();
    for entity in 0..*m {
        let numbers = &numbers[entity * features..][..features];
        for (to, &number) in observation.entity_mut(entity).iter_mut().zip(numbers) {
            *to = f32::from_ne_bytes(number);
        }
    }
    for agent in 0..*n {
        observation.observable_mut(agent).copy_from_slice(&observable[agent * m..][..*m]);
        observation.available_mut(agent).copy_from_slice(&available[agent * n_actions..][..n_actions]);
    }
    Ok(observation)
}

fn to_bytes(numbers: &[f32]) -> Cow<'static, [u8]> {
    numbers.iter().flat_map(|number| number.to_ne_bytes()).collect::<Vec<_>>().into()
}

#[pymodule]
mod _rit {
    #[pymodule_export]
    use super::{ActError, NativePolicy, RitError, WeightsError};
}
