//! Environments, the task sets made of them, and the loop that rolls episodes out. An environment knows no
//! network, no decision order and no transport.
//!
//! - [`Environment`]: what one task's world does; [`conformance`] is the suite every one of them passes.
//! - [`EnvironmentFactory`]: where worlds come from; [`Embedded`] makes those of this crate.
//! - [`TaskSet`]: which tasks belong together; which are for training, which for testing.
//! - [`register`]: task sets of a program of one's own.
//! - [`Seated`]: an environment seen in decision order.
//! - [`rollout`]: rolls numbered episodes with a [`rit_episode::Policy`], several at once.

pub mod combat;
pub mod conformance;
mod environment;
mod factory;
mod foreign;
pub mod matrix_game;
mod names;
mod own;
pub mod particle;
pub mod rollout;
mod scripts;
mod seated;
mod task_set;
mod unknown_name;

pub use environment::{
    BodyKind, Environment, EnvironmentError, EnvironmentOptions, FailureKind, LinkKind, Physics, Scene,
    SceneBody, SceneLink, SceneUnit, Spec, SpecError, Step,
};
pub use factory::{Embedded, EnvironmentFactory};
pub use foreign::{ForeignSet, ForeignTask};
pub use own::{Make, Maker, OwnTaskSet, OwnTaskSetError, register, registered};
pub use scripts::{Script, UnfitScript};
pub use seated::Seated;
pub use task_set::{PYTHON, Split, Task, TaskError, TaskSet};
pub use unknown_name::UnknownName;
