//! REFIL: utilities, and a mixing network that also mixes imagined sub-groups of agents and entities.
//!
//! Entities are split into two groups at random, anew for each episode of each update. Besides the real pass, every agent
//! goes through the episode twice more: seeing only its own group, and only the other one. The utilities of the actions
//! taken in these two passes are mixed to an imagined Q_total, which is trained towards the same TD target.

use crate::{
    ModelConfig, Rows,
    blocks::{Encoder, Mixer},
    drive::{Head, Pass, Role, Said, Sums, TdPass, Utilities, ValueNetwork, ValueParts, measures},
    estimators::td,
    learner::{Draw, Measure},
    method,
};
use rand::RngExt as _;
use rit_episode::{Episode, Stream};
use rit_nn::{
    Gru, Layout, LayoutBuilder, Linear, Tape, Var, View,
    attention::{Group, Visible},
};

/// Passes that go through an episode in training: the real one, within the own group, and across groups.
const PASSES: usize = 3;

const MEASURES: [Measure; 6] =
    measures::measures([Measure { name: "imagined_loss", help: "TD loss of imagined sub-groups" }], true);

/// The utility network, and all else in [`ValueParts`].
#[derive(Clone, Debug)]
pub struct Refil {
    parts: ValueParts,
    mixer: Mixer,
    /// Whether an agent's own features stand beside its attention.
    beside: bool,
    encoder: Encoder,
    gru: Gru,
    /// h → A.
    head: Linear,
    /// λ.
    imagined_weight: f32,
}

/// Which of its two groups every entity of every episode is in, `[m]` each.
pub type Groups = Vec<Vec<u8>>;

/// Who sees whom in the imagined passes, and where rows are.
#[derive(Debug, Default)]
pub struct Imagined {
    /// What agents are shown of their own group, and of the other one: the groups' `[n, m]` one after another.
    observed: [Vec<u8>; 2],
    /// Whether agents and entities are in one group, and the contrary.
    together: [Vec<u8>; 2],
    /// First row of each time where every agent has [`PASSES`] rows, then how many there are.
    times: Vec<usize>,
    /// The distinct entity that each of those rows' agent is.
    own: Vec<usize>,
    /// Of those rows, the ones of each pass.
    of_pass: [Vec<usize>; PASSES],
    /// Of those rows, each agent's two imagined ones, one after the other.
    imagined: Vec<usize>,
    /// The action of each of those rows.
    actions: Vec<u8>,
    /// The groups where every agent has two rows.
    pairs: Vec<Group>,
}

impl Refil {
    /// Declares the networks: utility, then mixer.
    pub fn new(config: &ModelConfig) -> Self {
        let (mut network, layout) = Layout::of(|layout| Self::declare(config, layout));
        network.parts.layout = layout;
        network
    }

    fn declare(config: &ModelConfig, layout: &mut LayoutBuilder) -> Self {
        let (h, a) = (config.hidden_dim, config.attention_dim);
        let beside = config.encoder == method::Encoder::Beside;
        let encoder = Encoder::new(layout, "utility", config.entity_dim, h, a, config.n_heads);
        let gru = Gru::new(layout, "utility.gru", if beside { h + a } else { a }, h);
        let head = Linear::new(layout, "utility.head", h, config.n_actions);
        let acting = 0..layout.len();
        let of_mixer = Encoder::new(layout, "mixer", config.entity_dim, h, a, config.n_heads);
        let mixer = Mixer::new(layout, of_mixer, 0, config.mixing_embed_dim, config.hypernet_embed_dim);
        let target = 0..layout.len();
        let layout = Layout::default();
        let parts = ValueParts {
            layout,
            acting,
            target,
            n_actions: config.n_actions,
            memory_dim: h,
            gru: true,
            mixer: Some(mixer.clone()),
            task: None,
        };
        Self { parts, mixer, beside, encoder, gru, head, imagined_weight: config.imagined_weight }
    }

    /// What the GRU reads of each pass, `own` being the distinct entities that its agents are.
    fn encode<'a>(
        &self,
        tape: &mut Tape<'a>,
        rows: &'a Rows,
        own: &'a [usize],
        masks: &[Visible<'a>],
    ) -> Var {
        if self.beside {
            self.encoder.beside_under(tape, rows, own, masks)
        } else {
            self.encoder.within(tape, rows, masks)
        }
    }
}

impl ValueNetwork for Refil {
    type Draws = Groups;
    type Inputs = Imagined;
    type Extras = Option<Var>;
    const DRAWS: bool = true;

    fn parts(&self) -> &ValueParts {
        &self.parts
    }

    fn measures(&self) -> &'static [Measure] {
        &MEASURES
    }

    fn td_weight(&self) -> f32 {
        1.0 - self.imagined_weight
    }

    /// Each episode has its own probability, uniform, with which each of its entities is in group 1.
    fn draw(&self, batch: &[&Episode], draw: Draw) -> Groups {
        let mut rng = draw.stream(Stream::ImaginedGroups);
        let groups = batch.iter().map(|episode| {
            let probability: f32 = rng.random();
            (0..episode.n_entities).map(|_| u8::from(rng.random::<f32>() < probability)).collect()
        });
        groups.collect()
    }

    fn inputs(&self, rows: &Rows, groups: &Groups, first_episode: usize) -> Imagined {
        if groups.is_empty() {
            return Imagined::default();
        }
        let mut inputs = Imagined {
            times: rows.agent_times.iter().map(|row| PASSES * row).collect(),
            own: rows.agent_distinct.iter().flat_map(|&row| [row; PASSES]).collect(),
            of_pass: [0, 1, 2].map(|pass| (0..rows.agent_rows()).map(|row| PASSES * row + pass).collect()),
            imagined: (0..rows.agent_rows()).flat_map(|row| [PASSES * row + 1, PASSES * row + 2]).collect(),
            actions: rows.actions.iter().flat_map(|&action| [action; PASSES]).collect(),
            ..Imagined::default()
        };
        let seen = if self.beside { &rows.others } else { &rows.observable };
        let mut pairs = seen.iter();
        for (group, step) in rows.groups.iter().zip(&rows.steps) {
            let members = &groups[first_episode + step.episode];
            for own in &members[..group.queries.len()] {
                for (other, &sees) in members.iter().zip(pairs.by_ref()) {
                    let together = u8::from(own == other);
                    for (at, holds) in [together, 1 - together].into_iter().enumerate() {
                        inputs.together[at].push(holds);
                        inputs.observed[at].push(sees * holds);
                    }
                }
            }
            inputs.pairs.push(Group {
                queries: 2 * group.queries.start..2 * group.queries.end,
                keys: group.keys.clone(),
            });
        }
        inputs
    }

    fn forward<'a>(&self, tape: &mut Tape<'a>, pass: Pass<'a, Imagined>) -> Utilities<'a, Option<Var>> {
        let Pass { rows, inputs, .. } = pass;
        let real = Visible::Where(if self.beside { &rows.others } else { &rows.observable });
        let [within, across] = &inputs.observed;
        let masks = [real, Visible::Where(within), Visible::Where(across)];
        let (masks, own, times) = match pass.role {
            Role::Online => (&masks[..], &inputs.own, &inputs.times),
            Role::Target | Role::Acting => (&masks[..1], &rows.agent_distinct, &rows.agent_times),
        };
        let encoded = self.encode(tape, rows, own, masks);
        let gates = tape.product_of(&self.gru.input, 0, &[encoded]);
        tape.free(encoded);
        let memory = tape.gru(&self.gru, gates, times, pass.before);
        let utilities = tape.linear(&self.head, memory);
        if pass.role != Role::Online {
            return Utilities { memory, head: Head::Independent(utilities), extras: None };
        }
        let [real, ..] = &inputs.of_pass;
        let (memory, real) = (tape.gather(memory, real), tape.gather(utilities, real));
        Utilities { memory, head: Head::Independent(real), extras: Some(utilities) }
    }

    fn sums<'a>(&self, tape: &mut Tape<'a>, pass: &TdPass<'a, '_, Self>, said: &mut Said) -> Sums {
        let (Some(utilities), Some(mixing)) = (*pass.extras, pass.mixing) else { return Sums::new() };
        let (rows, inputs) = (pass.rows, pass.inputs);
        let masks = inputs.together.each_ref().map(|flags| Visible::Where(flags));
        let weights = self.mixer.weights_under(tape, rows, &mixing, &masks);
        let chosen = tape.choose(utilities, &inputs.actions);
        let imagined = tape.gather(chosen, &inputs.imagined);
        let q_total = self.mixer.mix(tape, &inputs.pairs, &weights, imagined);
        let [_, within, interact] = inputs.of_pass.each_ref().map(|of_pass| tape.gather(utilities, of_pass));
        said.extend([
            ("utilities_within", within),
            ("utilities_interact", interact),
            ("imagined_q_total", q_total),
        ]);

        let (mut sum, mut d) = (0.0, vec![0.0; rows.groups.len()]);
        for (group, _) in rows.steps.iter().enumerate().filter(|(_, step)| step.filled) {
            let of_group = tape.slice(q_total)[group];
            let (loss, by) = td::squared_error(pass.td_targets[group], of_group, pass.totals.filled);
            sum += loss;
            d[group] = self.imagined_weight * by;
        }
        tape.seed(q_total, View::dense(&d, 1));
        vec![sum / pass.totals.filled as f64]
    }
}
