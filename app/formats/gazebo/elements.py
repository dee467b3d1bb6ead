"""Element names of SDFormat.

Source: gazebosim/sdformat, sdf/1.0 to sdf/1.12 (``<element name=…>`` of all descriptions).
"""

from __future__ import annotations

_NAMES = """
    accel acceleration accuracy actor air_pressure air_speed albedo_map allow_auto_disable altimeter always_on
    ambient ambient_occlusion_map angle angular angular_acceleration angular_velocity animation anti_aliasing
    aspect_ratio atmosphere attach_steps attenuation audio audio_sink audio_source auto_inertia_params auto_start
    axis axis2 axis2_state axis_state background battery bias_mean bias_stddev blend bone_attachment bounce box
    box_type bullet c1 c2 c3 camera camera_info_topic capsule cast_shadows category_bitmask center cfm cfm_damping
    child clip clouds coefficient collide_bitmask collide_without_contact collide_without_contact_bitmask collision
    collision_detector collision_engine collision_state color color_end color_range_image color_start cols cone
    constant constraints contact contact_max_correcting_vel contact_surface_layer convex_decomposition cubemap_uri
    custom_function custom_rpy cutoff_angle cx cy cylinder damping dart delay_start deletions density depth_camera
    detach_steps device diffuse direction dissipation distortion distribution double_sided dt duration
    dynamic_bias_correlation_time dynamic_bias_stddev dynamic_friction dynamics effort elastic_modulus elevation
    ellipsoid emissive emissive_map emitting empty enable_metrics enable_orientation enable_wind end
    env_texture_size environment_map erp essid f fade_dist falloff far far_clip fdir1 filename flesh_mass_fraction
    fluid_added_mass fog force force_torque format fov frame frame_id frequency friction friction2 friction_model
    fudge_factor fun fx fy gain gearbox_ratio gearbox_reference_body geometry glossiness glossiness_map gps
    granularity grasp_check grav_dir_x gravity grid gripper gripper_link gui heading_deg height heightmap horizontal
    horizontal_fov humidity image implicit_spring_damper imu include inertia inertial inherit_yaw initial_position
    inner_angle insertions intensity interpolate_x intrinsics island_threads iterations iters ixx ixy ixz iyy iyz
    izz joint joint_state k1 k2 k3 kd kinematic kp laser_retro latitude_deg layer length lens lidar lifetime light
    light_map light_on light_state lighting limit linear linear_acceleration linear_velocity link link_state
    localization logical_camera longitude_deg loop lower mag magnetic_field magnetometer mass material max max_angle
    max_contacts max_convex_hulls max_dist max_force max_frequency max_step_size max_transient_velocity max_vel
    max_velocity mean mean_size measure_direction mesh meta metal metalness metalness_map mimic min min_angle
    min_contact_count min_depth min_dist min_frequency min_height min_step_size min_velocity model model_count
    model_state mu mu2 multiplier must_be_base_link must_be_loop_joint name namespace navsat near near_clip noise
    normal normal_map ode offset optical_frame_id orientation_reference_frame origin origin_visual outer_angle
    output override_impact_capture_velocity override_stiction_transition_velocity p1 p2 p_cx p_cy p_fx p_fy
    palm_link parent particle_emitter particle_scatter_ratio particle_size patch_radius path pbr physics pitch
    placement_frame plane plastic_coef_restitution plastic_impact_velocity plugin point poissons_ratio polyline
    population pos pose position position_sensing power pp pq pr precision precon_iters pressure projection
    projection_type projector provide_feedback qq qr quadratic radii radius range rate ray real_time
    real_time_factor real_time_update_rate reference reference_altitude render_order resolution
    restitution_coefficient rfid rfidtag road rolling_friction roughness roughness_map rows rr s samples sampling
    save scale scale_rate scale_to_hfov scan scene screw_thread_pitch script sdf segmentation_type self_collide
    sensitivity sensor shader shadows shininess sim_time simbody size skin sky slip slip1 slip2 soft_cfm
    soft_contact soft_erp solver solver_type sonar sor specular specular_map speed sphere spherical_coordinates
    split_impulse split_impulse_penetration_threshold spot spring_reference spring_stiffness start state static
    static_friction stddev step stiffness submesh sunrise sunset surface surface_axis_equatorial surface_axis_polar
    surface_model surface_radius suspension temperature temperature_gradient texture thread_pitch
    thread_position_correction threshold time topic torque torsional track_visual trajectory transceiver
    transparency trigger_topic triggered tx ty type update_rate upper uri use_dynamic_moi_rescaling use_model_frame
    use_parent_model_frame use_patch_radius use_terrain_paging velocity velocity_decay velocity_sensing vertical
    vertical_position vertical_velocity view_controller viscous_friction visibility_flags visibility_mask visual
    visualize voltage voxel_resolution wall_time waypoint width wind world world_frame_orientation wrench x xp xq xr
    xx xy xyz xz y yp yq yr yy yz z zp zq zr zz
"""
ELEMENTS = frozenset(_NAMES.split())
"""Element names of all versions and parents; nesting is not distinguished."""
