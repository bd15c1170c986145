//! The model: which parts it has, and the layout of their parameters.

use crate::{
    ConfigError,
    contrastive::Discriminator,
    decoder::Tables,
    mixer::{Mixer, MixerState},
    rows::Rows,
    task_encoder::{TaskEncoder, TaskEncoderState},
    utility::{Utility, UtilityState},
};
use rit_nn::{Layout, LayoutBuilder, Scratch, View};
use std::ops::Range;

/// Sizes and parts of a model.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RitConfig {
    /// d.
    pub entity_dim: usize,
    /// A.
    pub n_actions: usize,
    /// h.
    pub hidden_dim: usize,
    /// a: all heads together.
    pub attention_dim: usize,
    /// Heads of every attention.
    pub n_heads: usize,
    /// Task representations; `None` is the ablation RIT-No-Task-Representations.
    pub task_representations: Option<TaskRepresentations>,
    /// How utilities become Q_total.
    pub mixing: Mixing,
}

/// Sizes of the task encoder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TaskRepresentations {
    /// h_z.
    pub dim: usize,
    /// r.
    pub reward_embed_dim: usize,
}

/// How utilities become Q_total.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mixing {
    /// The mixing network.
    Network {
        /// Size of the mixing layers.
        mixing_embed_dim: usize,
        /// Hidden size of the hyper-networks.
        hypernet_embed_dim: usize,
    },
    /// Their sum: RIT-VDN.
    Sum,
}

impl RitConfig {
    /// h_z, 0 without task representations.
    pub fn representation_dim(&self) -> usize {
        self.task_representations.map_or(0, |representations| representations.dim)
    }

    /// Checks every size.
    ///
    /// # Errors
    /// The first that no model can have.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let mut sizes = vec![
            ("entity_dim", self.entity_dim),
            ("n_actions", self.n_actions),
            ("hidden_dim", self.hidden_dim),
            ("attention_dim", self.attention_dim),
            ("n_heads", self.n_heads),
        ];
        if let Some(TaskRepresentations { dim, reward_embed_dim }) = self.task_representations {
            sizes.extend([("task_representation_dim", dim), ("reward_embed_dim", reward_embed_dim)]);
        }
        if let Mixing::Network { mixing_embed_dim, hypernet_embed_dim } = self.mixing {
            sizes
                .extend([("mixing_embed_dim", mixing_embed_dim), ("hypernet_embed_dim", hypernet_embed_dim)]);
        }
        if let Some((name, _)) = sizes.into_iter().find(|(_, size)| *size == 0) {
            return Err(ConfigError::Zero { name });
        }
        if !self.attention_dim.is_multiple_of(self.n_heads) {
            return Err(ConfigError::Heads { attention_dim: self.attention_dim, n_heads: self.n_heads });
        }
        Ok(())
    }
}

/// The model's parts. Parameters lie in the order utility (θ), task encoder (ω), mixer (σ), discriminator
/// (φ), so what acting needs and what the target network covers are prefixes of the flat buffer.
#[derive(Clone, Debug)]
pub struct Rit {
    /// What it was made from.
    pub config: RitConfig,
    /// Names and shapes of all parameters.
    pub layout: Layout,
    /// θ.
    pub utility: Utility,
    /// ω.
    pub task_encoder: Option<TaskEncoder>,
    /// σ; `None` for a sum.
    pub mixer: Option<Mixer>,
    /// φ.
    pub discriminator: Option<Discriminator>,
    acting_len: usize,
    target_len: usize,
}

impl Rit {
    /// Declares the model.
    ///
    /// # Errors
    /// When a size is one that no model can have.
    pub fn new(config: RitConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let layout = &mut LayoutBuilder::default();
        let utility = Utility::new(layout, &config);
        let task_encoder = config.task_representations.map(|sizes| TaskEncoder::new(layout, &config, sizes));
        let acting_len = layout.len();
        let mixer = match config.mixing {
            Mixing::Network { mixing_embed_dim, hypernet_embed_dim } => {
                Some(Mixer::new(layout, &config, mixing_embed_dim, hypernet_embed_dim))
            }
            Mixing::Sum => None,
        };
        let target_len = layout.len();
        let discriminator =
            config.task_representations.map(|sizes| Discriminator::new(layout, sizes.dim, config.hidden_dim));
        let layout = std::mem::take(layout).finish();
        Ok(Self { config, layout, utility, task_encoder, mixer, discriminator, acting_len, target_len })
    }

    /// The parameters that acting needs: utility and task encoder.
    pub fn acting(&self) -> Range<usize> {
        0..self.acting_len
    }

    /// The parameters that the target network covers: utility, task encoder and mixer.
    pub fn target(&self) -> Range<usize> {
        0..self.target_len
    }

    /// From rows to task representations z, left in `state`. `before` (rows of the first time, h) is the task
    /// encoder's recurrent state before the first time, or zeros.
    pub fn represent(
        &self,
        params: &[f32],
        rows: &Rows,
        before: Option<View<'_>>,
        state: &mut TaskEncoderState,
        scratch: &mut Scratch,
    ) {
        if let Some(task_encoder) = &self.task_encoder {
            task_encoder.forward(params, rows, before, state, scratch);
        }
    }

    /// All of the networks that needs no actions. `representation` is z (R, h_z).
    pub fn prepare(
        &self,
        params: &[f32],
        tables: &Tables,
        rows: &Rows,
        representation: View<'_>,
        state: &mut Networks,
        scratch: &mut Scratch,
    ) {
        self.utility.forward(params, tables, rows, None, representation, &mut state.utility, scratch);
        if let Some(mixer) = &self.mixer {
            mixer.prepare(params, rows, representation, &mut state.mixer);
        }
    }

    /// From what was prepared to Q_total (groups) of these actions (agent rows), left in `state.q_total`.
    pub fn value(&self, params: &[f32], tables: &Tables, rows: &Rows, actions: &[u8], state: &mut Networks) {
        let decoder = &mut state.utility.decoder;
        self.utility.decoder.forward(params, tables, rows, actions, decoder);
        state.chosen.clear();
        let utilities = decoder.utilities.chunks_exact(self.config.n_actions);
        state
            .chosen
            .extend(utilities.zip(actions).map(|(utilities, &action)| utilities[usize::from(action)]));
        state.q_total.clear();
        if let Some(mixer) = &self.mixer {
            mixer.forward(rows, &state.chosen, &mut state.mixer);
            state.q_total.extend_from_slice(&state.mixer.q_total);
        } else {
            let sums =
                rows.groups.iter().map(|group| state.chosen[group.queries.clone()].iter().sum::<f32>());
            state.q_total.extend(sums);
        }
    }

    /// z (R, h_z); of no columns without task representations.
    pub fn representation<'a>(&self, data: &'a [f32]) -> View<'a> {
        match self.config.representation_dim() {
            0 => View { data: &[], rows: 0, cols: 0, stride: 0 },
            dim => View::dense(data, dim),
        }
    }
}

/// What one set of weights made of one set of rows and their task representations.
#[derive(Debug, Default)]
pub struct Networks {
    /// The utility network's part, with τ and Q.
    pub utility: UtilityState,
    /// The mixer's part.
    pub mixer: MixerState,
    /// Utilities of the actions valued, `[R]`.
    pub chosen: Vec<f32>,
    /// Q_total of each group, `[groups]`.
    pub q_total: Vec<f32>,
}
