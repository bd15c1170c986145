//! MAT, the Multi-Agent Transformer: an encoder over what all agents see, and a decoder that chooses agent after agent,
//! each given the actions before its own. No recurrence.

mod acting;

pub use acting::MatActing;

use crate::{
    flat::Slots,
    learner::Measure,
    networks::Actor,
    on_policy::{self, ActorCritic, Inputs, Outputs, ValueRows},
};
use rit_nn::{
    Attention, LayerNorm, Layout, LayoutBuilder, Linear, View,
    attention::{Group, Visible},
    tape::{Tape, Var},
};
use std::{f32::consts::SQRT_2, ops::Range, sync::Arc};

/// What an update reports.
const MEASURES: [Measure; 9] =
    on_policy::measures([Measure { name: "grad_norm", help: "Gradient norm before clipping" }]);

/// Sizes of the networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MatConfig {
    /// Slots of the flat inputs.
    pub slots: Slots,
    /// A.
    pub n_actions: usize,
    /// e.
    pub embed_dim: usize,
    /// Heads of every attention.
    pub n_heads: usize,
    /// Blocks of the encoder, and of the decoder.
    pub n_blocks: usize,
}

/// Initial gain of layers in front of a GELU.
const BEFORE_GELU: f32 = SQRT_2;
/// Initial gain of all others.
const ELSEWHERE: f32 = 0.01;

/// The networks. The encoder's values come last: acting needs all but these.
#[derive(Clone, Debug)]
pub struct Mat {
    /// What it was made from.
    pub config: MatConfig,
    layout: Layout,
    input_norm: LayerNorm,
    embed: Linear,
    embed_norm: LayerNorm,
    encoder: Vec<EncoderBlock>,
    /// Of A + 1 tokens, the start token first; without bias.
    action_embed: Linear,
    action_norm: LayerNorm,
    decoder: Vec<DecoderBlock>,
    head: Head,
    value: Head,
    acting_len: usize,
}

impl Mat {
    /// Declares all parameters.
    pub fn new(config: MatConfig) -> Self {
        let MatConfig { slots, n_actions, embed_dim: e, n_heads, n_blocks } = config;
        let layout = &mut LayoutBuilder::default();
        let input_norm = LayerNorm::new(layout, "encoder.input_norm", slots.width());
        let embed =
            layout.orthogonal(BEFORE_GELU, |layout| Linear::new(layout, "encoder.embed", slots.width(), e));
        let embed_norm = LayerNorm::new(layout, "encoder.norm", e);
        let encoder = (0..n_blocks)
            .map(|index| EncoderBlock::new(layout, &format!("encoder.blocks.{index}"), e, n_heads))
            .collect();
        let action_embed = layout.orthogonal(BEFORE_GELU, |layout| {
            Linear::without_bias(layout, "decoder.action_embed", n_actions + 1, e)
        });
        let action_norm = LayerNorm::new(layout, "decoder.norm", e);
        let decoder = (0..n_blocks)
            .map(|index| DecoderBlock::new(layout, &format!("decoder.blocks.{index}"), e, n_heads))
            .collect();
        let head = Head::new(layout, "decoder.head", e, n_actions);
        let acting_len = layout.len();
        let value = Head::new(layout, "encoder.value", e, 1);
        let layout = std::mem::take(layout).finish();
        Self {
            config,
            layout,
            input_norm,
            embed,
            embed_norm,
            encoder,
            action_embed,
            action_norm,
            decoder,
            head,
            value,
            acting_len,
        }
    }

    /// What the encoder makes of the observations, (R, m d) to (R, e). `teams` are the groups' agent rows.
    fn encode<'a>(&self, tape: &mut Tape<'a>, observations: Var, teams: &'a [Group]) -> Var {
        let x = tape.layer_norm(&self.input_norm, observations);
        let mut x = normalized_gelu(tape, &self.embed, &self.embed_norm, x);
        for block in &self.encoder {
            x = block.forward(tape, x, teams);
        }
        x
    }

    /// The embedding of every token, (A + 1, e): the start token, then the actions.
    fn embed_tokens<'a>(&self, tape: &mut Tape<'a>, one_hots: &'a [f32]) -> Var {
        let one_hots = tape.constant(View::dense(one_hots, self.tokens()));
        let embedded = tape.product_of(&self.action_embed, 0, &[one_hots]);
        let x = tape.gelu(embedded);
        tape.layer_norm(&self.action_norm, x)
    }

    fn tokens(&self) -> usize {
        self.config.n_actions + 1
    }
}

impl ActorCritic for Mat {
    fn layout(&self) -> &Layout {
        &self.layout
    }

    fn acting(&self) -> Range<usize> {
        0..self.acting_len
    }

    fn clipped_apart(&self) -> Vec<Range<usize>> {
        std::iter::once(0..self.layout.len()).collect()
    }

    fn n_actions(&self) -> usize {
        self.config.n_actions
    }

    fn value_rows(&self) -> ValueRows {
        ValueRows::Agents
    }

    fn measures(&self) -> &'static [Measure] {
        const { &MEASURES }
    }

    fn fill(&self, inputs: &mut Inputs) {
        let Inputs { rows, observations, teams, before, tokens, one_hots, .. } = inputs;
        self.config.slots.observations(rows, observations);
        teams.clear();
        before.clear();
        tokens.clear();
        for group in &rows.groups {
            let n = group.queries.len();
            teams.push(Group { queries: group.queries.clone(), keys: group.queries.clone() });
            before.extend((0..n * n).map(|pair| u8::from(pair % n <= pair / n)));
            // Token 0 is the start token, token j the action of row j − 1.
            let actions = &rows.actions[group.queries.clone()];
            tokens.push(0);
            tokens.extend(actions[..n - 1].iter().map(|&action| usize::from(action) + 1));
        }
        identity(self.tokens(), one_hots);
    }

    fn forward<'a>(&self, tape: &mut Tape<'a>, inputs: &'a Inputs) -> Outputs {
        let observations = tape.constant(View::dense(&inputs.observations, self.config.slots.width()));
        let encoded = self.encode(tape, observations, &inputs.teams);
        let values = self.value.forward(tape, encoded);
        let tokens = self.embed_tokens(tape, &inputs.one_hots);
        let mut x = tape.gather(tokens, &inputs.tokens);
        for (index, block) in self.decoder.iter().enumerate() {
            let projected = match index {
                // There are few tokens and many rows.
                0 => block.self_attention.project(tape, tokens, tokens).gather(tape, &inputs.tokens),
                _ => block.self_attention.project(tape, x, x),
            };
            let before = Visible::Where(&inputs.before);
            x = block.forward(tape, x, projected, encoded, &inputs.teams, before);
        }
        Outputs { logits: self.head.forward(tape, x), values }
    }

    fn actor(self: Arc<Self>, params: &[f32]) -> Box<dyn Actor> {
        Box::new(MatActing::new(self, params))
    }
}

/// Fills a square matrix with the one-hots of this many tokens.
fn identity(len: usize, matrix: &mut Vec<f32>) {
    matrix.clear();
    matrix.extend((0..len * len).map(|at| if at % (len + 1) == 0 { 1.0 } else { 0.0 }));
}

/// y = norm(GELU(x Wᵀ + b)).
fn normalized_gelu(tape: &mut Tape<'_>, layer: &Linear, norm: &LayerNorm, x: Var) -> Var {
    let hidden = tape.linear(layer, x);
    let active = tape.gelu(hidden);
    tape.free(hidden);
    let y = tape.layer_norm(norm, active);
    tape.free(active);
    y
}

/// y = norm(x + z).
fn normalized_sum(tape: &mut Tape<'_>, norm: &LayerNorm, x: Var, z: Var) -> Var {
    let sum = tape.add(x, z);
    tape.free(z);
    let y = tape.layer_norm(norm, sum);
    tape.free(sum);
    y
}

/// A transformer's attention: linear values, and a projection after the heads.
#[derive(Clone, Debug)]
struct MultiHead {
    attention: Attention,
    proj: Linear,
}

impl MultiHead {
    fn new(layout: &mut LayoutBuilder, name: &str, e: usize, heads: usize) -> Self {
        layout.orthogonal(ELSEWHERE, |layout| Self {
            attention: Attention::linear(layout, name, e, e, heads),
            proj: Linear::new(layout, &format!("{name}.proj"), e, e),
        })
    }

    /// Queries of some rows; keys and values of some, maybe others.
    fn project(&self, tape: &mut Tape<'_>, queries: Var, keys: Var) -> Projected {
        Projected {
            queries: tape.linear(&self.attention.query, queries),
            key_values: tape.key_values(&self.attention, keys),
        }
    }

    /// What the queries see of the keys of their groups.
    fn attend<'a>(
        &self,
        tape: &mut Tape<'a>,
        Projected { queries, key_values }: Projected,
        groups: &'a [Group],
        visible: Visible<'a>,
    ) -> Var {
        let out = tape.attend(&self.attention, queries, key_values, groups, visible);
        tape.free(queries);
        let y = tape.linear(&self.proj, out);
        tape.free(out);
        y
    }
}

/// (Q, e) and (K, 2e).
#[derive(Clone, Copy)]
struct Projected {
    queries: Var,
    key_values: Var,
}

impl Projected {
    /// These rows of both.
    fn gather<'a>(self, tape: &mut Tape<'a>, rows: &'a [usize]) -> Self {
        let Self { queries, key_values } = self;
        Self { queries: tape.gather(queries, rows), key_values: tape.gather(key_values, rows) }
    }
}

/// Two layers with a GELU between them.
#[derive(Clone, Debug)]
struct Mlp(Linear, Linear);

impl Mlp {
    fn new(layout: &mut LayoutBuilder, name: &str, e: usize) -> Self {
        let first = format!("{name}.mlp1");
        let first = layout.orthogonal(BEFORE_GELU, |layout| Linear::new(layout, &first, e, e));
        let second = format!("{name}.mlp2");
        Self(first, layout.orthogonal(ELSEWHERE, |layout| Linear::new(layout, &second, e, e)))
    }

    fn forward(&self, tape: &mut Tape<'_>, x: Var) -> Var {
        let hidden = tape.linear(&self.0, x);
        let active = tape.gelu(hidden);
        tape.free(hidden);
        let y = tape.linear(&self.1, active);
        tape.free(active);
        y
    }
}

/// A normalised hidden layer with GELU under a last layer.
#[derive(Clone, Debug)]
struct Head {
    hidden: Linear,
    norm: LayerNorm,
    out: Linear,
}

impl Head {
    /// Declares `{name}_hidden`, `{name}_hidden_norm` and `{name}`.
    fn new(layout: &mut LayoutBuilder, name: &str, e: usize, outputs: usize) -> Self {
        let hidden = format!("{name}_hidden");
        let hidden = layout.orthogonal(BEFORE_GELU, |layout| Linear::new(layout, &hidden, e, e));
        let norm = LayerNorm::new(layout, &format!("{name}_hidden_norm"), e);
        let out = layout.orthogonal(ELSEWHERE, |layout| Linear::new(layout, name, e, outputs));
        Self { hidden, norm, out }
    }

    fn forward(&self, tape: &mut Tape<'_>, x: Var) -> Var {
        let x = normalized_gelu(tape, &self.hidden, &self.norm, x);
        let y = tape.linear(&self.out, x);
        tape.free(x);
        y
    }
}

/// x ← norm1(x + attention(x)); x ← norm2(x + mlp(x)).
#[derive(Clone, Debug)]
struct EncoderBlock {
    attention: MultiHead,
    norm1: LayerNorm,
    mlp: Mlp,
    norm2: LayerNorm,
}

impl EncoderBlock {
    fn new(layout: &mut LayoutBuilder, name: &str, e: usize, heads: usize) -> Self {
        Self {
            attention: MultiHead::new(layout, &format!("{name}.attention"), e, heads),
            norm1: LayerNorm::new(layout, &format!("{name}.norm1"), e),
            mlp: Mlp::new(layout, name, e),
            norm2: LayerNorm::new(layout, &format!("{name}.norm2"), e),
        }
    }

    fn forward<'a>(&self, tape: &mut Tape<'a>, x: Var, teams: &'a [Group]) -> Var {
        let projected = self.attention.project(tape, x, x);
        let attended = self.attention.attend(tape, projected, teams, Visible::All);
        tape.free(projected.key_values);
        let y = normalized_sum(tape, &self.norm1, x, attended);
        tape.free(x);
        let hidden = self.mlp.forward(tape, y);
        let z = normalized_sum(tape, &self.norm2, y, hidden);
        tape.free(y);
        z
    }
}

/// x ← norm1(x + self_attention(x)); x ← norm2(rep + cross_attention(rep, x)); x ← norm3(x + mlp(x)).
#[derive(Clone, Debug)]
struct DecoderBlock {
    self_attention: MultiHead,
    norm1: LayerNorm,
    cross_attention: MultiHead,
    norm2: LayerNorm,
    mlp: Mlp,
    norm3: LayerNorm,
}

impl DecoderBlock {
    fn new(layout: &mut LayoutBuilder, name: &str, e: usize, heads: usize) -> Self {
        Self {
            self_attention: MultiHead::new(layout, &format!("{name}.self_attention"), e, heads),
            norm1: LayerNorm::new(layout, &format!("{name}.norm1"), e),
            cross_attention: MultiHead::new(layout, &format!("{name}.cross_attention"), e, heads),
            norm2: LayerNorm::new(layout, &format!("{name}.norm2"), e),
            mlp: Mlp::new(layout, name, e),
            norm3: LayerNorm::new(layout, &format!("{name}.norm3"), e),
        }
    }

    /// `projected` is [`MultiHead::project`] of the self-attention over `x`.
    fn forward<'a>(
        &self,
        tape: &mut Tape<'a>,
        x: Var,
        projected: Projected,
        encoded: Var,
        teams: &'a [Group],
        before: Visible<'a>,
    ) -> Var {
        let attended = self.self_attention.attend(tape, projected, teams, before);
        let y = normalized_sum(tape, &self.norm1, x, attended);
        let projected = self.cross_attention.project(tape, encoded, y);
        let attended = self.cross_attention.attend(tape, projected, teams, before);
        self.finish(tape, encoded, attended)
    }

    /// What follows both attentions; `own` is what the encoder made of the rows.
    fn finish(&self, tape: &mut Tape<'_>, own: Var, attended: Var) -> Var {
        let y = normalized_sum(tape, &self.norm2, own, attended);
        let hidden = self.mlp.forward(tape, y);
        let z = normalized_sum(tape, &self.norm3, y, hidden);
        tape.free(y);
        z
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_parameters_as_pinned_and_values_last() {
        let slots = Slots { agents_max: 6, entities_max: 12, entity_dim: 12 };
        let mat = Mat::new(MatConfig { slots, n_actions: 5, embed_dim: 64, n_heads: 1, n_blocks: 1 });
        assert_eq!(mat.layout.len(), 86_374);
        for param in mat.layout.params() {
            let for_values = param.name.starts_with("encoder.value");
            assert_eq!(mat.acting().contains(&param.range.start), !for_values, "{}", param.name);
        }
    }
}
